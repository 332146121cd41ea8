"""The sample acquisition that comes with pixcal."""

from pathlib import Path

from pixcal.model.errors import InputError

PACKAGE = Path(__file__).parents[1]
# where an installed package has it, and where a clone has it
PLACES = (PACKAGE / "samples", PACKAGE.parents[1] / "data_samples")


def sample_acquisition() -> Path:
    """Folder of the sample acquisition: 96 x 80 pixels, 240 frames of each of two fringe sets.

    It is simulated, from ``configs/demo.yaml`` of the sources; the truth is beside it, in
    ``demo-truth``.

    Returns
    -------
    Path
        Of the folder with ``acquisition.yaml``.

    Raises
    ------
    InputError
        If this installation lacks it.
    """
    for place in PLACES:
        if (place / "demo" / "acquisition.yaml").is_file():
            return place / "demo"
    raise InputError(f"{PLACES[0]}: not there; install pixcal from its wheel or its sources")
