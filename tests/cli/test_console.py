"""Numbers as the commands print them."""

import pytest

from jeit.arguments import percent

SAID = {
    0.0: "0 %",
    1e-14: "less than 0.001 %",
    -2e-6: "less than 0.001 %",
    2.34e-5: "0.0023 %",
    0.0123: "1.2 %",
    0.994: "99 %",
    0.996: "100 %",
    -1.0: "-100 %",
    -1.26: "-126 %",
    123.4: "12340 %",
}


@pytest.mark.parametrize("value", SAID)
def test_per_cents_have_no_exponents(value):
    assert percent(value) == SAID[value]


def test_what_is_not_known():
    assert percent(None) == "not known"
