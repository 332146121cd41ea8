"""What the diagnosis compares: evidence, test statistics, and the gap between them."""
