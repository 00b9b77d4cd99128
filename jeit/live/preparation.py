"""Preparation of a source of frames and of the view that computes pictures, for `jeit live` and for programs."""

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

# Names of the files of learnt models in a folder.
_NETWORK_FILE, _SKIN_FILE, _GESTURES_FILE = "network.jeit", "skin.skops", "gestures.skops"
# Minimum and maximum number of frames of the undisturbed sensor from which a reference is computed.
_MIN_FRAMES, _MAX_FRAMES = 3, 10_000
# Period in seconds with which the connection of a source is checked.
_POLL_PERIOD = 0.3
# Time in seconds, from the arrival of the first frame, in which frames are attributed to lines that were sent before
# the program could read them.
_INITIAL_BURST_DURATION = 0.05


class Prepared(NamedTuple):
    """A source of frames, and the view that computes pictures from the frames, as returned by `prepare`.

    **Fields**: `source`, `view`: arguments of `jeit.live.frames` and `jeit.live.Session`; `reference`: the measurement
    of the undisturbed sensor, None if only frames without a protocol are known.

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
    """Open a source of frames, and prepare the view that computes pictures from the frames.

    Without `model` and `calibration`, the view shows the change of conductivity (`ConductivityView`).

    **Arguments:**

    - `source`: as in `open_source`; with a `model`, a recording is read as by `jeit touch predict`, and with a
      `calibration` as by `jeit locate`.
    - `reference`: measured file of the undisturbed sensor, which states the protocol and the electrodes.
    - `description`: a TOML file, or the name of a bundled description, that describes the frames; needed without a
      `reference`.
    - `model`: file or folder written by `jeit touch fit`, `jeit touch gestures` or `jeit learn image`. The view shows
      positions and forces (`LearntSkinView`), gestures (`GestureView`, which needs a description) or depth
      (`DepthView`).
    - `calibration`: file written by `jeit calibrate-microphones`. The view shows loss maps and positions of sounds
      (`SoundView`).
    - `contacts`: whether to find the contacts in the change of conductivity (`ContactsView`).
    - `settings`: settings of the reconstruction of conductivity changes.
    - `rate`: frames/s of a recording, or of the frames from which gestures are classified.
    - `untouched`: duration of the initial interval, in seconds, whose frames are the reference if no `reference` is
      given.
    - `progress`: function that is called with the name of each step when the step begins.

    Raises `ValueError` if an argument is missing or does not match the other arguments, and if a view or a reader of
    files raises it.

    **Example:**

    ```python
    source, view, reference = prepare("demo", contacts=True, settings=settings)
    print(next(frames(source, view)).picture.markers)
    ```
    """
    report_step = progress or (lambda task_name: None)
    if calibration is not None:
        if model is not None:
            raise ValueError("calibration= and model= are of different sensors; give one of them.")
        return Prepared(*_prepare_sound(source, calibration, rate), None)
    loaded_description = None if description is None else load_description(description)
    if model is not None:
        return _prepare_model(
            source, reference, description, loaded_description, Path(model), rate, untouched, report_step
        )
    reference_measurement = (
        reference if isinstance(reference, Measurement | None) else read(reference, None, description)
    )
    opened_source = open_source(source, rate=rate, description=description, reference=reference_measurement)
    with _closed_on_failure(opened_source):
        reference_measurement = (
            getattr(opened_source, "reference", None) if reference_measurement is None else reference_measurement
        )
        if reference_measurement is None:
            if loaded_description is None:
                raise ValueError(
                    "reference is missing: give a measured file of the undisturbed sensor, or a description, and the "
                    "first frames are the reference."
                )
            reference_frames, opened_source = first_frames(opened_source, untouched, report_step, rate=rate)
            reference_measurement = described_reference(loaded_description, reference_frames)
        else:
            reference_frames = frames_of(reference_measurement)
        conductivity_view = ConductivityView.prepare(reference_measurement, settings, progress=progress)
        if not contacts:
            return Prepared(opened_source, conductivity_view, reference_measurement)
        from jeit.live.views.contacts import ContactsView

        return Prepared(opened_source, ContactsView(conductivity_view, reference_frames), reference_measurement)


@contextmanager
def _closed_on_failure(source: AbstractSource) -> Iterator[None]:
    """Context that closes a source, and so ends a thread that reads the source, if an error is raised in the
    context."""
    try:
        yield
    except BaseException:
        source.close()
        raise


def first_frames(
    source: AbstractSource,
    seconds: float,
    report: Callable[[str], None] | None = None,
    *,
    rate: float | None = None,
) -> tuple[Float[np.ndarray, "N M"], AbstractSource]:
    """Read the frames of the first `seconds` of a source; return these frames and a source of the frames that follow.

    Lines that were sent before the program could read them arrive all at once. The number of returned frames is
    therefore `seconds` times the frame rate: `rate`, in frames/s, or else the rate of the frames that arrive later, one
    by one. Frames that are not numbers, or whose length differs from that of most frames, are left out. If the source
    is a recording, the returned source plays the recording from its beginning. `report` is called with the name of the
    task, and with the reason of any wait for the device. Raises `ValueError` if fewer than three frames remain.
    """
    if isinstance(source, PlayedRecording):
        return _frames_of_usual_length(list(source.frames[source.seconds <= seconds]), seconds), source
    with _report_connection(source, f"undisturbed, {seconds:g} s", report or (lambda report_step: None)):
        return _read_first_frames(source, seconds, rate)


@contextmanager
def _report_connection(source: AbstractSource, task_name: str, report_step: Callable[[str], None]) -> Iterator[None]:
    """Context that reports the task `task_name`, and each change of the state of the source's connection."""
    end_event = threading.Event()

    def report_changes() -> None:
        last_connection_state = CONNECTED
        while not end_event.wait(_POLL_PERIOD):
            if source.connection != last_connection_state:
                last_connection_state = source.connection
                report_step(task_name if last_connection_state == CONNECTED else last_connection_state)

    report_step(task_name)
    report_thread = threading.Thread(target=report_changes, daemon=True)
    report_thread.start()
    try:
        yield
    finally:
        end_event.set()
        report_thread.join()


def _read_first_frames(
    source: AbstractSource, reading_seconds: float, frame_rate: float | None
) -> tuple[Float[np.ndarray, "N M"], AbstractSource]:
    frames, initial_frames = iter(source), []
    num_frames = None if frame_rate is None else max(round(frame_rate * reading_seconds), _MIN_FRAMES)
    for frame in frames:
        is_late = num_frames is None and frame.second - (initial_frames or [frame])[0].second >= reading_seconds
        if is_late or len(initial_frames) >= (num_frames or _MAX_FRAMES):
            frames = chain([frame], frames)
            break
        if num_frames is None or not isinstance(frame.values, str):
            initial_frames.append(frame)
    if num_frames is None and (measured_rate := _arrival_rate(initial_frames)) is not None:
        num_frames = max(round(measured_rate * reading_seconds), _MIN_FRAMES)
    reference_frames = _frames_of_usual_length(
        [frame.values for frame in initial_frames[:num_frames] if not isinstance(frame.values, str)], reading_seconds
    )
    if (relative_change := change_during(reference_frames)) is not None:
        source.say(
            f"The sensor changed by {100 * relative_change:.2g} % in the first {reading_seconds:g} s, which are the "
            "reference: take a new one while nothing touches the sensor."
        )
    return reference_frames, _ContinuedSource(
        source, chain(initial_frames[len(initial_frames) if num_frames is None else num_frames :], frames)
    )


def _arrival_rate(frames: list[LiveFrame]) -> float | None:
    """Rate of arrival in frames/s, without the first frames, which arrived all at once; None if all frames arrived at
    once."""
    arrival_times = np.array([frame.arrived for frame in frames])
    later_arrivals = arrival_times[arrival_times > (arrival_times[:1] + _INITIAL_BURST_DURATION)]
    return (
        (len(later_arrivals) - 1) / (later_arrivals[-1] - later_arrivals[0])
        if len(later_arrivals) > 2 and later_arrivals[-1] > later_arrivals[0]
        else None
    )


def _frames_of_usual_length(frame_rows: list[np.ndarray], reading_seconds: float) -> Float[np.ndarray, "N M"]:
    """Return the frames of the most frequent length as one array. Raises `ValueError` if there are fewer than three
    such frames."""
    row_lengths = [len(frame_row) for frame_row in frame_rows]
    usual_length = max(set(row_lengths), key=row_lengths.count, default=0)
    frame_rows = [frame_row for frame_row in frame_rows if len(frame_row) == usual_length]
    if len(frame_rows) < _MIN_FRAMES:
        raise ValueError(
            f"untouched: the first {reading_seconds:g} s have {counted(len(frame_rows), 'frame')} of numbers; "
            f"{_MIN_FRAMES} are needed. Give a longer time, or a reference."
        )
    return np.array(frame_rows, float)


class _ContinuedSource(AbstractSource):
    """A source whose first frames have already been read. `remaining`: iterator over the frames that follow."""

    def __init__(self, source: AbstractSource, remaining_frames: Iterator[LiveFrame]):
        self._source, self._remaining_frames = source, remaining_frames

    def __getattr__(self, name: str) -> Any:
        return getattr(self._source, name)

    def __iter__(self) -> Iterator[LiveFrame]:
        return self._remaining_frames

    def close(self) -> None:
        """End the iteration soon."""
        self._source.close()

    def end_when_lost(self) -> None:
        """End when the connection is lost; see `AbstractSource.end_when_lost`."""
        self._source.end_when_lost()


def _prepare_sound(
    source: str, calibration_path: str | Path, frame_rate: float | None
) -> tuple[AbstractSource, AbstractView]:
    """Create the source of intensities and the view of a calibrated array of microphones. The file `source` may contain
    sound samples or intensities."""
    from jeit.acoustic import Calibration, read_recording
    from jeit.acoustic.calibration.calibration import calibrated_intensities
    from jeit.live.views.sound import SoundView

    loaded_calibration = Calibration.load(calibration_path)
    if not Path(source).is_file():
        return open_source(source, rate=frame_rate), SoundView(loaded_calibration)
    silent_intensities = calibrated_intensities(read_recording(source), loaded_calibration)
    silent_power = np.where(silent_intensities.usable, silent_intensities.power, np.nan)
    sound_view = SoundView(loaded_calibration, floor=silent_intensities.floor, freedom=silent_intensities.freedom)
    return PlayedRecording(source, silent_power, np.asarray(silent_intensities.times), frame_rate), sound_view


def _prepare_model(
    source: str,
    reference: Measurement | str | Path | None,
    description: str | Path | None,
    loaded_description: Description | None,
    path: Path,
    frame_rate: float | None,
    untouched_seconds: float,
    report_step: Callable[[str], None],
) -> Prepared:
    """Create the source of frames, and the view of the learnt model in the file or folder `path`."""
    from jeit.touch import GestureModel, LearntSkin

    model = _read_model(path)
    if isinstance(model, GestureModel) and loaded_description is None:
        raise ValueError("description is missing: gestures are named from images of the skin, which it describes.")
    reference_measurement = reference if isinstance(reference, Measurement) else None
    reference_frames = None if reference_measurement is None else frames_of(reference_measurement)
    if reference is not None and not isinstance(reference, Measurement):
        reference_recording = read_frame_recording(reference, loaded_description)
        reference_frames = (
            reference_recording.frames if reference_recording.reference is None else reference_recording.reference
        )
    if Path(source).is_file():
        reference_recording_of_source = read_frame_recording(source, loaded_description)
        reference_frames = reference_recording_of_source.reference if reference_frames is None else reference_frames
        opened_source: AbstractSource = PlayedRecording(
            source, reference_recording_of_source.frames, reference_recording_of_source.seconds, frame_rate
        )
    else:
        opened_source = open_source(source, rate=frame_rate, description=description, reference=reference_measurement)
        reference_measurement = (
            getattr(opened_source, "reference", None) if reference_measurement is None else reference_measurement
        )
        reference_frames = (
            frames_of(reference_measurement)
            if reference_frames is None and reference_measurement is not None
            else reference_frames
        )
    with _closed_on_failure(opened_source):
        if reference_frames is None and not (isinstance(model, LearntSkin) and model.mean_reference is None):
            reference_frames, opened_source = first_frames(
                opened_source, untouched_seconds, report_step, rate=frame_rate
            )
        if isinstance(model, LearntSkin):
            from jeit.live.views.learnt import LearntSkinView

            return Prepared(
                opened_source,
                LearntSkinView(model, reference_frames, description=loaded_description),
                reference_measurement,
            )
        assert reference_frames is not None
        if isinstance(model, GestureModel):
            from jeit.live.views.contacts import GestureView

            assert loaded_description is not None
            model_view: AbstractView = GestureView(
                loaded_description, model, reference_frames, rate=frame_rate, progress=report_step
            )
            return Prepared(
                opened_source,
                model_view,
                described_reference(loaded_description, reference_frames)
                if reference_measurement is None
                else reference_measurement,
            )
        from jeit.live.views.learnt import DepthView

        return Prepared(opened_source, DepthView(model, reference_frames), reference_measurement)


def _read_model(path: Path):
    """Read a learnt skin, learnt gestures or a network from a file, or from the only file of a model in a folder.

    Raises `ValueError` if there is no file of a model at `path`, and for a folder with several files of models.
    """
    if path.is_dir():
        file_names = [name for name in (_SKIN_FILE, _GESTURES_FILE, _NETWORK_FILE) if (path / name).is_file()]
        if len(file_names) > 1:
            raise ValueError(f"model: '{path}' holds {' and '.join(file_names)}; give one of these files.")
        path = path / file_names[0] if file_names else path
    if not path.is_file() or path.suffix not in (".skops", ".jeit"):
        fitting_commands = "'jeit touch fit', 'jeit touch gestures' or 'jeit learn image'"
        raise ValueError(f"model: '{path}' is neither a folder of {fitting_commands}, nor a file of such a folder.")
    if path.suffix == ".jeit":
        from jeit.touch.networks import read_network

        return read_network(path)
    from jeit.touch import GestureModel, read_skin

    if path.name == _GESTURES_FILE:
        return GestureModel.read(path)
    try:
        return read_skin(path)
    except ValueError as error:
        if "of another kind" not in str(error):
            raise
        return GestureModel.read(path)
