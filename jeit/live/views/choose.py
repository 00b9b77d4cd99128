"""Choice of the view by what is known of the sensor, and the first frames of a source as its reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from jeit.arguments import counted
from jeit.data import Measurement, load_description
from jeit.imaging.stream_preparation import StreamSettings, described_reference, frames_of
from jeit.live.pictures import AbstractView, LiveFrame
from jeit.live.sources import AbstractSource
from jeit.live.views.conductivity import ConductivityView

if TYPE_CHECKING:
    from jeit.data.description import Description

# Files that a folder of a learnt model holds, by kind.
_NETWORK, _SKIN, _GESTURES = "network.jeit", "skin.skops", "gestures.skops"
# Fewest frames of an undisturbed sensor, and most of which a reference is made.
_FEWEST, _MOST = 3, 10_000


def open_view(
    reference: Measurement | None = None,
    *,
    still: Float[np.ndarray, "N M"] | None = None,
    description: str | Path | None = None,
    model: str | Path | None = None,
    calibration: str | Path | None = None,
    contacts: bool = False,
    settings: StreamSettings | None = None,
    rate: float | None = None,
    progress: Callable[[str], None] | None = None,
) -> AbstractView:
    """The view of a sensor, by what is known of it.

    - `calibration`: file of calibrated microphones: `SoundView`.
    - `model`: file or folder of `jeit touch fit`, `jeit touch gestures` or `jeit learn image`: `LearntSkinView`,
      `GestureView` or `DepthView`.
    - neither: the change of conductivity, `ConductivityView`, or with `contacts` the contacts in it, `ContactsView`,
      imaged with `settings`.

    `reference`: measurement of the undisturbed sensor. Without it, `still` (N, M), frames of the undisturbed sensor,
    volts, and `description`, TOML file or name of a bundled one, which gestures need in any case. `rate`: frames/s, for
    gestures. `progress` is called with each step as it begins. Raises `ValueError` where something is missing, and as
    the views.
    """
    if calibration is not None:
        from jeit.acoustic import Calibration
        from jeit.live.views.sound import SoundView

        if model is not None:
            raise ValueError("calibration= and model= are of different sensors; give one of them.")
        return SoundView(Calibration.load(calibration))
    described = None if description is None else load_description(description)
    if reference is not None:
        still = frames_of(reference)
    if model is not None:
        return _learnt_view(Path(model), described, still, rate, progress)
    if reference is None:
        if still is None or described is None:
            raise ValueError(
                "reference is missing: give a measured file of the undisturbed sensor, or a description of it, and the "
                "first frames are the reference."
            )
        reference = described_reference(described, still)
    images = ConductivityView.prepare(reference, settings, progress=progress)
    if not contacts:
        return images
    from jeit.live.views.contacts import ContactsView

    return ContactsView(images, still)


def _learnt_view(
    path: Path,
    description: Description | None,
    still: Float[np.ndarray, "N M"] | None,
    rate: float | None,
    progress: Callable[[str], None] | None,
) -> AbstractView:
    kind = _kind_of(path)
    if kind == _SKIN:
        from jeit.live.views.learnt import LearntSkinView
        from jeit.touch import read_skin

        return LearntSkinView(read_skin(path), still, description=description)
    if still is None:
        raise ValueError("reference is missing: give frames of the untouched skin.")
    if kind == _NETWORK:
        from jeit.live.views.learnt import DepthView
        from jeit.touch.networks import read_network

        return DepthView(read_network(path), still)
    if description is None:
        raise ValueError("description is missing: gestures are named from images of the skin, which it describes.")
    from jeit.live.views.contacts import GestureView
    from jeit.touch import GestureModel

    return GestureView(description, GestureModel.read(path), still, rate=rate, progress=progress)


def _kind_of(path: Path) -> str:
    """Name of the file of a model that a path is or holds."""
    kinds = (_SKIN, _GESTURES, _NETWORK)
    held = [one for one in kinds if (path / one).is_file()] if path.is_dir() else []
    if len(held) == 1:
        return held[0]
    if len(held) > 1:
        raise ValueError(f"model: '{path}' holds {' and '.join(held)}; give one of these files.")
    if path.is_file():
        ending = path.suffix == ".jeit"
        return _NETWORK if ending else _GESTURES if "gesture" in path.name else _SKIN
    raise ValueError(f"model: '{path}' is no folder of 'jeit touch fit', 'jeit touch gestures' or 'jeit learn image'.")


def first_frames(source: AbstractSource, seconds: float) -> tuple[Float[np.ndarray, "N M"], AbstractSource]:
    """Read the frames of the first `seconds` of a source, and return them with a source of those that follow.

    Frames that are no numbers, or of another length than most, are left out. Raises `ValueError` if fewer than three
    remain.
    """
    coming, rows = iter(source), []
    began = None
    for frame in coming:
        began = frame.second if began is None else began
        if not isinstance(frame.values, str):
            rows.append(frame.values)
        if frame.second - began >= seconds or len(rows) >= _MOST:
            break
    widths = [len(one) for one in rows]
    usual = max(set(widths), key=widths.count, default=0)
    rows = [one for one in rows if len(one) == usual]
    if len(rows) < _FEWEST:
        source.close()
        raise ValueError(
            f"untouched: the first {seconds:g} s have {counted(len(rows), 'frame')} of numbers; {_FEWEST} are needed. "
            "Give a longer time, or a reference."
        )
    return np.array(rows, float), _Continued(source, coming)


class _Continued(AbstractSource):
    """A source of which some frames have been read already."""

    def __init__(self, source: AbstractSource, coming: Iterator[LiveFrame]):
        self._source, self._coming = source, coming

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def __iter__(self) -> Iterator[LiveFrame]:
        return self._coming

    def close(self) -> None:
        """End the iteration soon."""
        self._source.close()
