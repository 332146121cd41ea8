# What `pixcal/__init__.py` gives when it is asked, for type checkers and editors.
from pixcal.api import FringeSet as FringeSet
from pixcal.api import InputError as InputError
from pixcal.api import OffsetMap as OffsetMap
from pixcal.api import Picture as Picture
from pixcal.api import PixcalError as PixcalError
from pixcal.api import PixelFlag as PixelFlag
from pixcal.api import Run as Run
from pixcal.api import Runtime as Runtime
from pixcal.api import allan as allan
from pixcal.api import astrometry as astrometry
from pixcal.api import budget as budget
from pixcal.api import calibrate as calibrate
from pixcal.api import compare as compare
from pixcal.api import correct_centroids as correct_centroids
from pixcal.api import crests as crests
from pixcal.api import diagnose as diagnose
from pixcal.api import distortion_wcs as distortion_wcs
from pixcal.api import fit as fit
from pixcal.api import ingest as ingest
from pixcal.api import open_run as open_run
from pixcal.api import reduce as reduce
from pixcal.api import run as run
from pixcal.api import sample_acquisition as sample_acquisition
from pixcal.api import simulate as simulate
from pixcal.api import write_report as write_report

__version__: str
