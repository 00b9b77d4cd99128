"""From two frames to a picture in one call, `image_difference`, and what every rule for λ would choose on the way.

`settings` says how to image, `preparation` checks, meshes and calibrates, `method` images, `difference` looks for
inclusions; `stream` does it frame after frame.
"""

from jeit.imaging.compared_rules import ComparedRules as ComparedRules
from jeit.imaging.compared_rules import RuleOutcome as RuleOutcome
from jeit.imaging.compared_rules import compare_on_data as compare_on_data
from jeit.imaging.difference import ImagedDifference as ImagedDifference
from jeit.imaging.difference import image_difference as image_difference
from jeit.imaging.method import METHODS as METHODS
from jeit.imaging.preparation import PreparedDifference as PreparedDifference
from jeit.imaging.preparation import calibrated_model as calibrated_model
from jeit.imaging.preparation import imaging_mesh as imaging_mesh
from jeit.imaging.preparation import prepare_difference as prepare_difference
from jeit.imaging.preparation import select_frames as select_frames
from jeit.imaging.settings import CONTACTS as CONTACTS
from jeit.imaging.settings import ImagingSettings as ImagingSettings
from jeit.imaging.stream import StreamSettings as StreamSettings
from jeit.imaging.stream import frames_of as frames_of
from jeit.imaging.stream import prepare_imager as prepare_imager
