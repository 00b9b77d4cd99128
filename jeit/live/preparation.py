"""A source and a view of what is known of the sensor, for the command and for programs."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jeit.arguments import counted
from jeit.data import Measurement, load_description, read, read_frame_recording
from jeit.data.description import Description
from jeit.imaging.stream_preparation import StreamSettings, described_reference, frames_of
from jeit.live.pictures import AbstractView, LiveFrame
from jeit.live.quality import change_during
from jeit.live.sources import CONNECTED, AbstractSource, PlayedRecording, open_source
from jeit.live.views.conductivity import ConductivityView

# Files that a folder of a learnt model holds, by kind.
_NETWORK, _SKIN, _GESTURES = "network.jeit", "skin.skops", "gestures.skops"
# Fewest frames of an undisturbed sensor, and most of which a reference is made.
_FEWEST, _MOST = 3, 10_000
# Seconds between looks at the connection of a source; seconds in which lines that were sent before arrive.
_LOOK, _BURST = 0.3, 0.05


class Prepared(NamedTuple):
    """A source, and the view of its sensor, as from `prepare`.

    **Fields**: `source`, `view`: what `jeit.live.frames` and `jeit.live.Session` take; `reference`: the measurement of
    the undisturbed sensor, None if only its frames are known.

    **Example:**

    ```python
    source, view, reference = prepare("demo", settings=settings)
    print(reference.num_channels)
    ```
    """

    source: AbstractSource
    view: AbstractView
    reference: Measurement | None


def prepare(
    source: str,
    reference: Measurement | str | Path | None = None,
    *,
    description: str | Path | None = None,
    model: str | Path | None = None,
    calibration: str | Path | None = None,
    contacts: bool = False,
    settings: StreamSettings | None = None,
    rate: float | None = None,
    untouched: float = 1.0,
    progress: Callable[[str], None] | None = None,
) -> Prepared:
    """Open a source, and prepare the view of its sensor, by what is known of it.

    Without `model` and `calibration`, the view is the change of conductivity (`ConductivityView`).

    **Arguments:**

    - `source`: as in `open_source`; with a `model`, a recording is read as by `jeit touch predict`, and with a
      `calibration` as by `jeit locate`.
    - `reference`: measured file of the undisturbed sensor, which says protocol and electrodes.
    - `description`: a TOML file or the name of a bundled one, which says what the frames are without a `reference`.
    - `model`: file or folder of `jeit touch fit`, `jeit touch gestures` or `jeit learn image`: places and forces
      (`LearntSkinView`), gestures (`GestureView`, which needs a description) or depth (`DepthView`).
    - `calibration`: file of `jeit calibrate-microphones`: loss maps and places of sounds (`SoundView`).
    - `contacts`: whether to find the contacts in the change of conductivity (`ContactsView`).
    - `settings`: how changes of conductivity are imaged.
    - `rate`: frames/s of a recording, and for gestures.
    - `untouched`: time from the beginning, seconds, whose frames are the reference if none is given.
    - `progress`: called with each step as it begins.

    Raises `ValueError` where something is missing or does not fit, and as the views and readers.

    **Example:**

    ```python
    source, view, reference = prepare("demo", contacts=True, settings=settings)
    print(next(frames(source, view)).picture.markers)
    ```
    """
    report = progress or (lambda step: None)
    if calibration is not None:
        if model is not None:
            raise ValueError("calibration= and model= are of different sensors; give one of them.")
        return Prepared(*_with_sound(source, calibration, rate), None)
    described = None if description is None else load_description(description)
    if model is not None:
        return _with_model(source, reference, description, described, Path(model), rate, untouched, report)
    measured = reference if isinstance(reference, Measurement | None) else read(reference, None, description)
    opened = open_source(source, rate=rate, description=description, reference=measured)
    measured = getattr(opened, "reference", None) if measured is None else measured
    if measured is None:
        if described is None:
            raise ValueError(
                "reference is missing: give a measured file of the undisturbed sensor, or a description, and the first "
                "frames are the reference."
            )
        still, opened = first_frames(opened, untouched, report, rate=rate)
        measured = described_reference(described, still)
    else:
        still = frames_of(measured)
    images = ConductivityView.prepare(measured, settings, progress=progress)
    if not contacts:
        return Prepared(opened, images, measured)
    from jeit.live.views.contacts import ContactsView

    return Prepared(opened, ContactsView(images, still), measured)


def first_frames(
    source: AbstractSource,
    seconds: float,
    report: Callable[[str], None] | None = None,
    *,
    rate: float | None = None,
) -> tuple[Float[np.ndarray, "N M"], AbstractSource]:
    """Read the frames of the first `seconds` of a source, and return them with a source of those that follow.

    Lines that were sent before the program could read them arrive all at once. The number of frames is therefore
    `seconds` times the frame rate: `rate`, frames/s, or else that of the frames that arrive one after the other.
    Frames that are no numbers, or of another length than most, are left out; a recording is played from its beginning
    nevertheless. `report` is called with what is done, and with the reason while a device is waited for. Raises
    `ValueError` if fewer than three frames remain.
    """
    if isinstance(source, PlayedRecording):
        return _enough(list(source.frames[source.seconds <= seconds]), seconds), source
    with _reporting(source, f"undisturbed, {seconds:g} s", report or (lambda said: None)):
        return _first_frames(source, seconds, rate)


@contextmanager
def _reporting(source: AbstractSource, task: str, report: Callable[[str], None]) -> Iterator[None]:
    """Report a task, and whenever the state of the source's connection changes."""
    done = threading.Event()

    def follow() -> None:
        said = CONNECTED
        while not done.wait(_LOOK):
            if source.connection != said:
                said = source.connection
                report(task if said == CONNECTED else said)

    report(task)
    thread = threading.Thread(target=follow, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def _first_frames(
    source: AbstractSource, seconds: float, rate: float | None
) -> tuple[Float[np.ndarray, "N M"], AbstractSource]:
    frames, first = iter(source), []
    number = None if rate is None else max(round(rate * seconds), _FEWEST)
    for frame in frames:
        is_late = number is None and frame.second - (first or [frame])[0].second >= seconds
        if is_late or len(first) >= (number or _MOST):
            frames = chain([frame], frames)
            break
        if number is None or not isinstance(frame.values, str):
            first.append(frame)
    if number is None and (measured_rate := _rate_of_arrival(first)) is not None:
        number = max(round(measured_rate * seconds), _FEWEST)
    try:
        still = _enough([frame.values for frame in first[:number] if not isinstance(frame.values, str)], seconds)
    except ValueError:
        source.close()
        raise
    if (change := change_during(still)) is not None:
        source.say(
            f"The sensor changed by {100 * change:.2g} % in the first {seconds:g} s, which are the reference: take a "
            "new one while nothing touches the sensor."
        )
    return still, _Continued(source, chain(first[len(first) if number is None else number :], frames))


def _rate_of_arrival(frames: list[LiveFrame]) -> float | None:
    """The rate of frames, frames/s, without those at the beginning that arrived all at once; None if all did."""
    arrivals = np.array([frame.arrived for frame in frames])
    late = arrivals[arrivals > (arrivals[:1] + _BURST)]
    return (len(late) - 1) / (late[-1] - late[0]) if len(late) > 2 and late[-1] > late[0] else None


def _enough(rows: list[np.ndarray], seconds: float) -> Float[np.ndarray, "N M"]:
    """Frames of the usual length as one array; raises `ValueError` if these are fewer than three."""
    widths = [len(one) for one in rows]
    usual = max(set(widths), key=widths.count, default=0)
    rows = [one for one in rows if len(one) == usual]
    if len(rows) < _FEWEST:
        raise ValueError(
            f"untouched: the first {seconds:g} s have {counted(len(rows), 'frame')} of numbers; {_FEWEST} are needed. "
            "Give a longer time, or a reference."
        )
    return np.array(rows, float)


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

    def end_when_lost(self) -> None:
        """End when the connection is lost; see `AbstractSource.end_when_lost`."""
        self._source.end_when_lost()


def _with_sound(source: str, calibration: str | Path, rate: float | None) -> tuple[AbstractSource, AbstractView]:
    """A source of intensities and the view of a calibrated array of microphones; of a file, samples or intensities."""
    from jeit.acoustic import Calibration, read_recording
    from jeit.acoustic.localisation.calibrated_intensities import calibrated_intensities
    from jeit.live.views.sound import SoundView

    known = Calibration.load(calibration)
    if not Path(source).is_file():
        return open_source(source, rate=rate), SoundView(known)
    intensities = calibrated_intensities(read_recording(source), known)
    power = np.where(intensities.usable, intensities.power, np.nan)
    view = SoundView(known, floor=intensities.floor, freedom=intensities.freedom)
    return PlayedRecording(source, power, np.asarray(intensities.times), rate), view


def _with_model(
    source: str,
    reference: Measurement | str | Path | None,
    description: str | Path | None,
    described: Description | None,
    path: Path,
    rate: float | None,
    untouched: float,
    report: Callable[[str], None],
) -> Prepared:
    """A source of plain frames, and the view of what was learnt."""
    from jeit.touch import GestureModel, LearntSkin

    model = _read_model(path)
    if isinstance(model, GestureModel) and described is None:
        raise ValueError("description is missing: gestures are named from images of the skin, which it describes.")
    measured = reference if isinstance(reference, Measurement) else None
    still = None if measured is None else frames_of(measured)
    if reference is not None and not isinstance(reference, Measurement):
        recorded = read_frame_recording(reference, described)
        still = recorded.frames if recorded.reference is None else recorded.reference
    if Path(source).is_file():
        played = read_frame_recording(source, described)
        still = played.reference if still is None else still
        opened: AbstractSource = PlayedRecording(source, played.frames, played.seconds, rate)
    else:
        opened = open_source(source, rate=rate, description=description, reference=measured)
        measured = getattr(opened, "reference", None) if measured is None else measured
        still = frames_of(measured) if still is None and measured is not None else still
    if still is None and not (isinstance(model, LearntSkin) and model.mean_reference is None):
        still, opened = first_frames(opened, untouched, report, rate=rate)
    if isinstance(model, LearntSkin):
        from jeit.live.views.learnt import LearntSkinView

        return Prepared(opened, LearntSkinView(model, still, description=described), measured)
    assert still is not None
    if isinstance(model, GestureModel):
        from jeit.live.views.contacts import GestureView

        assert described is not None
        view: AbstractView = GestureView(described, model, still, rate=rate, progress=report)
        return Prepared(opened, view, described_reference(described, still) if measured is None else measured)
    from jeit.live.views.learnt import DepthView

    return Prepared(opened, DepthView(model, still), measured)


def _read_model(path: Path):
    """The learnt skin, gestures or network that a path is, or that its folder holds.

    Raises `ValueError` for a path without any, and for a folder with several.
    """
    if path.is_dir():
        held = [one for one in (_SKIN, _GESTURES, _NETWORK) if (path / one).is_file()]
        if len(held) > 1:
            raise ValueError(f"model: '{path}' holds {' and '.join(held)}; give one of these files.")
        path = path / held[0] if held else path
    if not path.is_file() or path.suffix not in (".skops", ".jeit"):
        made = "'jeit touch fit', 'jeit touch gestures' or 'jeit learn image'"
        raise ValueError(f"model: '{path}' is neither a folder of {made}, nor a file of such a folder.")
    if path.suffix == ".jeit":
        from jeit.touch.networks import read_network

        return read_network(path)
    from jeit.touch import GestureModel, read_skin

    if path.name == _GESTURES:
        return GestureModel.read(path)
    try:
        return read_skin(path)
    except ValueError as error:
        if "of another kind" not in str(error):
            raise
        return GestureModel.read(path)
