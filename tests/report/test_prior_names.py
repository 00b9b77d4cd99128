"""The prior that a report names is the one used: that of the settings, or the fixed one of the method."""

import pytest

from jeit.imaging import ImagingSettings
from jeit.inverse import Matern
from jeit.report.image import _prior_name


@pytest.mark.parametrize(
    ("settings", "dimension", "name"),
    [
        (ImagingSettings(method="one-step", prior="noser"), 2, "noser"),
        (ImagingSettings(method="gauss-newton", prior=Matern(0.02)), 3, "Matern"),
        (ImagingSettings(method="total-variation"), 2, "total variation"),
        (ImagingSettings(method="shapes"), 2, "star shapes"),
        (ImagingSettings(method="shapes"), 3, "ellipsoids and columns"),
    ],
)
def test_the_prior_of_the_method_or_of_the_settings_is_named(settings, dimension, name):
    assert _prior_name(settings, dimension) == name
