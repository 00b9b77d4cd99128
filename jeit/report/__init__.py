"""What is told of results, and all that is written to a folder: measurements, images, streams, compared rules,
calibrations of microphones, tracks, layouts, studies."""

from jeit.report.calibration import draw_calibration as draw_calibration
from jeit.report.calibration import write_calibration as write_calibration
from jeit.report.compared_rules import draw_choice as draw_choice
from jeit.report.compared_rules import report_choice as report_choice
from jeit.report.compared_rules import write_choice as write_choice
from jeit.report.image import draw_image as draw_image
from jeit.report.image import report_image as report_image
from jeit.report.image import write_image as write_image
from jeit.report.layout_comparison import draw_layout_comparison as draw_layout_comparison
from jeit.report.layout_comparison import report_layout_comparison as report_layout_comparison
from jeit.report.layout_comparison import write_layout_comparison as write_layout_comparison
from jeit.report.layout_improvement import draw_improved_layout as draw_improved_layout
from jeit.report.layout_improvement import report_improved_layout as report_improved_layout
from jeit.report.layout_improvement import write_improved_layout as write_improved_layout
from jeit.report.measurement import report_measurement as report_measurement
from jeit.report.stream import write_stream as write_stream
from jeit.report.study import write_study_report as write_study_report
from jeit.report.track import draw_track as draw_track
from jeit.report.track import report_track as report_track
from jeit.report.track import write_track as write_track
