"""`Listener`: a sound classifier, trained on labelled clips, that classifies the sound of a recording every 0.1 s."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jeit.acoustic import Calibration, Recording, locate_touches
from jeit.arguments import check_key, check_kind, check_name, counted
from jeit.arguments.extras import need_extra
from jeit.files import reason
from jeit.touch.learnt.answers import Standing
from jeit.touch.learnt.methods import fit_sharpness, probabilities
from jeit.touch.listening.feature_images import BANDS, EVERY, image_blocks
from jeit.touch.listening.labelled_clips import LabelledClips, mix_channels
from jeit.touch.listening.learners import BATCHES, LEARNERS
from jeit.touch.listening.sound_labels import SoundLabels
from jeit.touch.listening.windows import LOUD, Windows, held_out_folds
from jeit.touch.training import read_model, write_model

METHODS = ("auto", *LEARNERS)
# Methods that "auto" tries: the paper's schedule is left out, since this library's gives an equally good network in
# fewer batches.
_TRIED = tuple(name for name in LEARNERS if name != "paper-network")
# Maximum number of folds in which clips are held out; power below which a window is quiet, relative to that of the
# quietest training window.
_FOLDS, _QUIET = 3, 0.25
# Minimum loudness of a recording with a lower gain than the clips, relative to that of the softest clip; minimum number
# of windows for which a network is tried.
_SOFTER, _FOR_NETWORKS = 1 / 16, 3000
# Number of samples within which the readings of a working microphone change.
_LOOKED_AT = 100_000
_KIND, _VERSION = "a jeit listener", 2


@dataclass(frozen=True)
class Listener:
    """A trained classifier of sounds.

    **Fields**: `names` (C,): the classes; `method` and the trained `model`; `channels`: number of microphones, 1 if
    they are mixed; `highest`: maximum frequency used, Hz; `loudness`: whether loudness is a feature, otherwise all
    windows are scaled to equal loudness; `quietest`: minimum loudness of a training window; `clips_loudness`: loudness
    of the softest and of the loudest clip; `sharpness`: factor of the log-odds from which probabilities are computed;
    `doubt`: fraction of the probability that is spread evenly over all classes, 1 / (n + 2) for n held-out clips, since
    these support no higher confidence. `standing`: predictions for the held-out clips, and errors of all methods that
    were tried, the best first; None for a listener that was read from a file; `notes`: remarks on the training; `name`:
    name of the clips.

    **Example:**

    ```python
    listener = Listener.fit(clips, method="linear")
    print(listener.classify(recordings[0]).whole)
    ```
    """

    names: tuple[str, ...]
    method: str
    model: Any
    channels: int
    highest: float
    loudness: bool
    quietest: float
    clips_loudness: tuple[float, float]
    sharpness: float
    doubt: float
    standing: Standing | None = None
    notes: tuple[str, ...] = ()
    name: str = "clips"

    @classmethod
    def fit(
        cls,
        clips: LabelledClips,
        *,
        method: str = "auto",
        loudness: bool | None = None,
        key: Array | None = None,
        batches: int = BATCHES,
        folder: str | Path | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> "Listener":
        """Train a listener on labelled clips.

        `method`: one of `METHODS`; "auto" chooses the one that classifies most held-out clips correctly, each as a
        whole. Clips are held out in three folds, together with all clips of their group. The training windows of a clip
        are those at most 20 dB below its loudest, since the label does not describe the rest; in clips longer than 4 s,
        every sound counts as a clip. "auto" does not try the network if there are few windows. `loudness`: whether
        loudness is used as a feature; by default, it is if a linear discriminant then classifies more clips correctly,
        by more than chance. `key`: draws the initial weights of the networks, each trained for at most `batches`;
        `folder`: folder for checkpoints, from which an interrupted training can resume; `progress`: is called with a
        description of the progress. Raises `ValueError` for invalid clips, key or method; `ImportError` without the
        extra `learn`.
        """
        need_extra("learn", "learning to classify sounds")
        check_kind("clips", clips, LabelledClips, "clips as of read_clips(folder)")
        check_name("method", method, METHODS)
        key = jax.random.key(0) if key is None else key
        check_key(key)
        report = progress or (lambda said: None)
        windows = Windows.from_clips(clips, report)
        fold = held_out_folds(windows.right_of_clip, windows.group_of_clip, _FOLDS)
        notes = [*clips.notes, *windows.notes]
        alone = np.array(windows.names)[np.unique(windows.right_of_clip[fold < 0])]
        if alone.size:
            notes.append(
                f"{', '.join(alone)}: clips of one group only, which are never held out; their accuracy is not known."
            )
        names = _TRIED if method == "auto" else (method,)
        if method == "auto" and len(windows.clip) < _FOR_NETWORKS:
            names = tuple(name for name in names if name != "network")
            notes.append(
                f"no network was tried: {len(windows.clip)} windows are few for one, and {_FOR_NETWORKS} would not be."
            )
        loud = windows.images.loudness
        of_clips = np.maximum.reduceat(loud, np.flatnonzero(np.diff(windows.clip, prepend=-1)))
        if loudness is None:
            loudness = _is_loudness_useful(windows, fold, key, report)
        if not loudness:
            windows = windows.levelled
        found = []
        for name in names:
            found.append((name, _held_out_odds(name, windows, fold, key, batches, folder, report)))
        kept = [(windows.errors(odds), place, name, odds) for place, (name, odds) in enumerate(found)]
        # Methods are listed with the simplest last, which is chosen among methods with equal errors.
        kept.sort(key=lambda one: (*one[0], -one[1]))
        (_, _, chosen, odds) = kept[0]
        report(f"{chosen}, all clips")
        everything = windows.training_set(
            np.ones(len(windows.clip), bool), key, batches, _checkpoint_path(folder, chosen), report
        )
        model = LEARNERS[chosen].learn(everything)
        out = np.isfinite(odds).all(axis=1)
        standing = None
        if out.any():
            said, right = windows.predict_clips(odds)
            tried = [(name, errors[0]) for errors, _, name, _ in kept]
            standing = Standing(chosen, tried, np.array(windows.names)[said], np.array(windows.names)[right])
        else:
            notes.append(
                "no class has clips of two groups: nothing could be held out, and nobody knows how good it is."
            )
        # If all of a few held-out clips are classified correctly, the likelihood alone does not limit the confidence;
        # `doubt`, from the rule of succession, does.
        sharpness = min(1.0, fit_sharpness(odds[out], windows.right[out])) if out.any() else 1.0
        asked = 0 if standing is None else len(standing.right)
        return cls(
            windows.names,
            chosen,
            model,
            clips.channels,
            clips.highest,
            loudness,
            float(loud.min()),
            (float(of_clips.min()), float(of_clips.max())),
            sharpness,
            1 / (asked + 2),
            standing,
            tuple(notes),
            clips.name,
        )

    def classify(self, recording: Recording, *, calibration: Calibration | None = None) -> SoundLabels:
        """Classify every window of a recording; windows are 0.5 s long and begin every 0.1 s.

        A shorter recording is padded with silence. With a `calibration` of the microphones, places are estimated where
        the localiser finds them. If the listener has one channel, the channels of the recording are mixed.
        Raises `ValueError` if `recording` is no recording of samples, has another number of microphones, or no sound up
        to the frequency `highest`, and as `locate_touches` does.
        """
        check_kind("recording", recording, Recording, "a Recording of samples, as of read_recording(path)")
        notes = []
        whole = recording
        if self.channels == 1 and len(recording.samples) > 1:
            recording = mix_channels(recording)
            notes.append(f"{len(whole.samples)} channels were mixed to one, as the listener has it.")
        if len(recording.samples) != self.channels:
            raise ValueError(
                f"{recording.name} has {counted(len(recording.samples), 'microphone')}, and the listener was learnt "
                f"from clips of {self.channels}; record with as many, or train a listener on clips of this array."
            )
        if recording.rate < 2 * self.highest * (1 - 1e-3):
            raise ValueError(
                f"{recording.name} has {recording.rate:g} samples a second, sound up to {recording.rate / 2:g} Hz, and "
                f"the listener uses sound up to {self.highest:g} Hz; record {2 * self.highest:g} a second or more, "
                "or train a listener on clips of this rate."
            )
        bad = int((~np.isfinite(recording.samples)).sum())
        if bad:
            notes.append(f"{counted(bad, 'sample')} not finite: taken for silence.")
        dead = np.flatnonzero([len(np.unique(one[np.isfinite(one)][:_LOOKED_AT])) < 2 for one in whole.samples])
        if dead.size:
            notes.append(f"microphones that never move: {', '.join(map(str, dead))}.")
        parts = [
            (
                one.times,
                one.loudness,
                one.known,
                one.strongest,
                self.model.log_odds(one if self.loudness else one.levelled),
            )
            for one in image_blocks(recording, self.highest)
        ]
        times, loudness, known, strongest, odds = (np.concatenate(own) for own in zip(*parts, strict=True))
        quiet = loudness < self._quiet_threshold(float(loudness.max()))
        if quiet.all() and loudness.max() > 0:
            notes.append("all of it is quieter than anything learnt from: is the gain another?")
        place, std = (None, None) if calibration is None else _estimate_places(whole, calibration, times)
        share = probabilities(odds, self.sharpness)
        return SoundLabels(
            times,
            (1 - self.doubt) * share + self.doubt / share.shape[1],
            self.names,
            quiet,
            known,
            strongest,
            (loudness >= LOUD * loudness.max()) & (loudness > 0),
            recording.name,
            tuple(notes),
            place,
            std,
        )

    def _quiet_threshold(self, loudest: float) -> float:
        """Compute the loudness below which windows are quiet, in a recording whose loudest window is `loudest`.

        If loudness is not a feature, the recording's gain may differ from that of the clips: up to 12 dB lower, or any
        amount higher.
        """
        softest, greatest = self.clips_loudness
        gain = 1.0 if self.loudness else float(np.clip(loudest / softest, _SOFTER, 1)) * max(1.0, loudest / greatest)
        return _QUIET * self.quietest * gain

    def write(self, path: str | Path) -> None:
        """Write the listener, without its `standing`, to one file that consists of a JSON header and arrays.

        Raises `ValueError` if `path` is a folder.
        """
        own, arrays = self.model.to_stored()
        head = {
            "names": list(self.names),
            "method": self.method,
            "channels": self.channels,
            "highest_Hz": self.highest,
            "loudness_counts": self.loudness,
            "quietest": self.quietest,
            "clips_loudness": list(self.clips_loudness),
            "sharpness": self.sharpness,
            "doubt": self.doubt,
            "notes": list(self.notes),
            "name": self.name,
            "model": own,
        }
        write_model(path, _KIND, _VERSION, head, arrays)

    @classmethod
    def read(cls, path: str | Path) -> "Listener":
        """Read a listener from a file that `write` wrote, or from the folder that `jeit listen fit` made.

        Nothing in the file is executed. Raises `FileNotFoundError`, and `ValueError` for files of another kind.
        """
        path = Path(path)
        if path.is_dir():
            path = path / "listener.jeit"
        if not path.is_file():
            raise FileNotFoundError(f"'{path}': there is no such file; `jeit listen fit` makes one.")

        def make(head: dict[str, Any]) -> Any:
            check_name("its method", head["method"], tuple(LEARNERS))
            return LEARNERS[head["method"]].stored_shapes(head["model"], len(head["names"]), head["channels"] + BANDS)

        head, arrays = read_model(path, _KIND, _VERSION, make)
        try:
            model = LEARNERS[head["method"]].from_stored(head["model"], arrays)
            numbers = (float(head[name]) for name in ("highest_Hz", "quietest", "sharpness", "doubt"))
            highest, quietest, sharpness, doubt = numbers
            softest, greatest = map(float, head["clips_loudness"])
            names, notes, name = tuple(map(str, head["names"])), tuple(map(str, head["notes"])), str(head["name"])
            channels, loudness = int(head["channels"]), bool(head["loudness_counts"])
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise ValueError(f"'{path}' is not {_KIND} that can be read: {reason(error)}.") from None
        return cls(
            names,
            head["method"],
            model,
            channels,
            highest,
            loudness,
            quietest,
            (softest, greatest),
            sharpness,
            doubt,
            notes=notes,
            name=name,
        )


def _held_out_odds(
    name: str, windows: Windows, fold: np.ndarray, key: Array, batches: int, folder, report
) -> np.ndarray:
    """Compute the log-odds (W, C) of windows by models that are fitted without the fold of their clip.

    They are NaN for windows that are never held out.
    """
    odds = np.full((len(windows.images), windows.classes), np.nan)
    for number in range(int(fold.max()) + 1):
        report(f"{name}, fold {number + 1} of {int(fold.max()) + 1}")
        out = (fold == number)[windows.clip]
        lesson = windows.training_set(~out, key, batches, _checkpoint_path(folder, f"{name}-{number}"), report)
        odds[out] = LEARNERS[name].learn(lesson).log_odds(windows.images[out])
    return odds


def _is_loudness_useful(windows: Windows, fold: np.ndarray, key: Array, report) -> bool:
    """Determine whether loudness improves a linear discriminant by more than one standard deviation of chance.

    If no clip can be held out, loudness is used if there are several microphones, which share one gain.
    """
    if fold.max() < 0:
        return windows.images.intensity.shape[1] > 1
    right = []
    for own in (windows, windows.levelled):
        said, truth = own.predict_clips(_held_out_odds("linear", own, fold, key, 1, None, report))
        right.append(said == truth)
    more, fewer = (right[0] & ~right[1]).sum(), (right[1] & ~right[0]).sum()
    return bool(more - fewer > np.sqrt(more + fewer))


def _checkpoint_path(folder: str | Path | None, name: str) -> Path | None:
    return None if folder is None else Path(folder) / f"{name}.training"


def _estimate_places(
    recording: Recording, calibration: Calibration, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the touched places (W, d) and their standard deviations, metres, around the middle of each window.

    They are means over the frames of the smoothed track, NaN if there are none.
    """
    found = locate_touches(recording, calibration)
    place, spread = found.track.position, np.sqrt(np.diagonal(found.track.covariance, axis1=1, axis2=2))
    near = np.abs(found.locations.times - times[:, None]) <= EVERY / 2
    near &= np.isfinite(place).all(axis=1)
    count = near.sum(axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):
        return (near @ np.nan_to_num(place)) / np.where(count, count, np.nan), (
            near @ np.nan_to_num(spread)
        ) / np.where(count, count, np.nan)
