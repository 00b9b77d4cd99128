"""Views for kinds of sensors and models: classes that compute pictures from frames."""

from __future__ import annotations
