"""One file per physical effect of the bench."""
