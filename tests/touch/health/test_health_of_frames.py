"""The health of a skin estimated from frames alone: lasting steps, electrodes, repair, and refused input."""

import numpy as np
import pytest

from jeit.protocol import two_terminal
from jeit.touch import SkinHealth, watch
from jeit.touch.health import EventKind, EventStatus, WatchStatus

ELECTRODES = 8
PROTOCOL = two_terminal(ELECTRODES)
NUMBER = PROTOCOL.num_measurements
REST = np.linspace(0.8, 1.6, NUMBER)


def recording(seed: int, number: int = 600, noise: float = 1e-3, drift: float = 2e-5) -> np.ndarray:
    """Frames (F, M) with touches of about ten frames along a line of channels, noise and drift."""
    random = np.random.default_rng(seed)
    frames, at = np.tile(REST, (number, 1)), 5
    while at < number - 12:
        place, size = random.uniform(0, NUMBER), random.uniform(0.02, 0.1)
        frames[at : at + 10] += size * np.exp(-((np.arange(NUMBER) - place) ** 2) / 8)
        at += int(random.integers(14, 40))
    frames += drift * np.cumsum(random.normal(size=frames.shape), axis=0)
    return frames + noise * random.normal(size=frames.shape)


@pytest.fixture(scope="module")
def health() -> SkinHealth:
    return SkinHealth.fit(recording(0), protocol=PROTOCOL)


def damage() -> np.ndarray:
    """Scattered and of both signs, as from no touch."""
    random = np.random.default_rng(9)
    return 0.05 * np.where(random.random(NUMBER) < 0.3, random.choice([-1, 1], NUMBER), 0.0)


@pytest.mark.slow
def test_healthy_touches_are_no_events(health):
    reported = [len(watch(health, recording(seed, 300)).events) for seed in range(1, 41)]
    assert sum(map(bool, reported)) == 0


def test_a_lasting_change_is_reported_with_its_time_and_place(health):
    frames = recording(50)
    frames[301:] += damage()
    (event,) = watch(health, frames).events
    assert event.kind == EventKind.CHANGED
    assert event.status == EventStatus.LASTING
    assert abs(event.frame - 301) <= 2
    assert event.strength > 1
    assert set(np.flatnonzero(damage())) <= set(np.flatnonzero(event.channels))
    assert event.channels.sum() < 0.7 * NUMBER
    np.testing.assert_allclose(event.change, damage(), atol=0.01)


def test_the_whole_recording_gives_the_same_as_frame_by_frame(health):
    frames = recording(51)
    frames[250:] += damage()
    followed = health
    for time, frame in enumerate(frames):
        followed = followed.follow(float(time), frame)
    whole = watch(health, frames)
    assert [one.frame for one in whole.events] == [one.frame for one in followed.events]
    np.testing.assert_array_equal(whole.reference, followed.reference)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_units_do_not_matter(factor):
    frames = recording(52)
    frames[300:] += damage()
    plain, scaled = (watch(SkinHealth.fit(f * recording(0)), f * frames).events for f in (1.0, factor))
    assert [(one.frame, one.kind) for one in plain] == [(one.frame, one.kind) for one in scaled]
    assert len(plain) == 1


def held_press(start: int = 200, end: int = 600) -> np.ndarray:
    frames = recording(53, drift=0.0)
    frames[start:end] += 0.08 * np.exp(-((np.arange(NUMBER) - 12) ** 2) / 8)
    return frames


def test_a_lasting_press_is_recognised_by_time_or_by_the_user():
    health = SkinHealth.fit(recording(0), patience=250.0)
    waiting = watch(health, held_press()[:400])
    assert waiting.events == ()
    assert waiting.held is not None
    assert waiting.held.status == EventStatus.HELD
    assert abs(waiting.held.frame - 200) <= 2
    assert waiting.deny(waiting.held).held is None
    (sure,) = waiting.confirm(waiting.held).events
    assert sure.status == EventStatus.CONFIRMED
    (lasted,) = watch(health, held_press()).events
    assert lasted.noticed - lasted.time >= 250
    assert "looks the same" in lasted.reason
    assert watch(health, held_press(end=300)).events == ()


def test_an_event_that_the_user_denies_is_withdrawn():
    health = SkinHealth.fit(recording(0), patience=250.0)
    reported = watch(health, held_press())
    denied = reported.deny(reported.events[0])
    assert denied.open_events == []
    np.testing.assert_allclose(denied.reference, reported.reference - reported.events[0].change)


@pytest.mark.parametrize(("kind", "reading"), [(EventKind.TORN, 0.0), (EventKind.TORN, 5.0), (EventKind.DEAD, None)])
def test_an_electrode_that_fails_is_named_and_left_out(health, kind, reading):
    frames, own = recording(54), PROTOCOL.channels_touching(5)
    random = np.random.default_rng(2)
    shape = frames[300:, own].shape
    # During a touch.
    frames[280:320] += 0.08 * np.exp(-((np.arange(NUMBER) - 12) ** 2) / 8)
    frames[300:, own] = (7.0 + REST[own] if reading is None else reading) + 1e-3 * random.normal(size=shape)
    after = watch(health, frames)
    (event,) = after.events
    assert (event.electrode, event.kind) == (5, kind)
    assert event.reason.endswith("channels of electrode 6.")  # sentences count from 1
    np.testing.assert_array_equal(after.trusted, ~own)
    np.testing.assert_array_equal(after.usable, ~own)
    assert after.status == WatchStatus.PARTIAL


def test_two_electrodes_that_fail_at_once_are_both_named(health):
    frames = recording(55)
    frames[300:, PROTOCOL.channels_touching([2, 6])] = 0.0
    assert {one.electrode for one in watch(health, frames).events} == {2, 6}


def test_a_loose_electrode_is_named(health):
    frames, own = recording(56), PROTOCOL.channels_touching(3)
    random = np.random.default_rng(3)
    frames[300:, own] += REST[own] * (0.8 + 0.2 * random.normal(size=(300, 1)))
    assert [(one.electrode, one.kind) for one in watch(health, frames).events] == [(3, EventKind.LOOSE)]


def faulty(kind: str, channel: int = 9) -> np.ndarray:
    frames, random = recording(60), np.random.default_rng(4)
    if kind == "noisy":
        frames[300:, channel] += 8e-3 * random.normal(size=300)
    elif kind == "jumps":
        frames[300:, channel] += 0.2 * random.integers(0, 2, 300)
    else:
        frames[300:, channel] = frames[300, channel]
    return frames


@pytest.mark.parametrize(("kind", "message"), [("noisy", "noisy"), ("jumps", "noisy"), ("stuck", "stuck")])
def test_a_single_faulty_channel_is_named_and_left_out(health, kind, message):
    after = watch(health, faulty(kind))
    (event,) = [one for one in after.events if one.kind in (EventKind.NOISY, EventKind.STUCK)]
    assert event.kind == f"{message} channel"
    assert np.flatnonzero(event.channels).tolist() == [9]
    assert f"Channel 9 {'is several' if message == 'noisy' else 'does not move'}" in event.reason
    assert np.flatnonzero(~after.trusted).tolist() == [9]
    assert event.noticed - 300 <= 2.5 * health.healthy.window * health.healthy.stride
    denied = after.deny(event)
    assert denied.trusted.all()
    again = watch(denied, faulty(kind)[400:], 1000 + np.arange(200.0))
    assert [one.number for one in again.events if one.kind == event.kind] == [event.number]


def test_counts_of_a_coarse_converter_are_healthy():
    counts = 2e-3
    health = SkinHealth.fit(np.round(recording(0) / counts))
    reported = [watch(health, np.round(recording(seed, 300) / counts)).events for seed in range(61, 76)]
    assert sum(map(bool, reported)) == 0
    frames = recording(76)
    frames[301:] += damage()
    assert [abs(one.frame - 301) <= 2 for one in watch(health, np.round(frames / counts)).events] == [True]


def test_repeated_rows_and_constant_channels():
    healthy = np.repeat(recording(0, 300), 2, axis=0)
    healthy[:, 3] = 1.0
    health = SkinHealth.fit(healthy)
    assert not health.healthy.used[3]
    frames = recording(77)
    frames[301:] += damage()
    frames[:, 3] = 1.0
    (event,) = watch(health, np.repeat(frames, 2, axis=0)).events
    assert abs(event.frame - 602) <= 4


def test_repair_is_reported_and_the_reference_is_renewed(health):
    frames = recording(57, 900)
    frames[300:600] += damage()
    after = watch(health, frames)
    assert [one.kind for one in after.events] == [EventKind.CHANGED, EventKind.REPAIRED]
    assert after.events[0].status == EventStatus.MENDED
    assert after.open_events == []
    damaged = watch(health, frames[:600])
    mended = damaged.repaired(frames[-20:])
    assert mended.open_events == []
    np.testing.assert_allclose(mended.reference, frames[-20:].mean(axis=0), atol=0.02)
    assert watch(mended, frames[620:], 1000 + np.arange(280.0)).events == mended.events


def test_frames_are_compared_with_a_reference_taken_before_the_first(health):
    """A day later gains differ and the skin is undamaged. Later damage is reported."""
    gains = 1 + 0.05 * np.random.default_rng(2).normal(size=NUMBER)
    later = recording(57) * gains
    (event,) = watch(health, later).events
    assert "gains or contacts" in event.reason
    fresh = health.repaired(np.tile(REST * gains, (10, 1)))
    assert [event.kind for event in watch(fresh, later).events] == [EventKind.REPAIRED]
    later[301:] += damage()
    event = watch(fresh, later).events[-1]
    assert event.kind == EventKind.CHANGED
    assert abs(event.frame - 301) <= 2
    outside, most = health.healthy.fraction_outside(event.change), health.healthy.max_fraction_outside
    assert f"{100 * outside:.0f} % of it is in no direction of touches; of those, {100 * most:.0f} %" in event.reason


def test_a_recording_that_begins_damaged_is_reported(health):
    (event,) = watch(health, recording(58) + 4 * damage()).events
    assert event.frame == 0


def test_frames_with_missing_readings(health):
    frames, times = recording(59), np.arange(600.0)
    frames[300:] += damage()
    frames[::7, 4] = np.nan
    frames[100:104] = np.nan
    times[200:] += 400
    times[350] = times[349]
    after = watch(health, frames, times)
    assert [abs(one.frame - 300) <= 3 for one in after.events] == [True]
    assert after.frames == 600
    refused = health.follow(0.0, frames[0]).follow(0.0, frames[1])
    assert (refused.status, refused.time) == (WatchStatus.REFUSED, 0.0)
    assert health.follow(0.0, frames[100]).status == WatchStatus.REFUSED
    assert watch(health, np.zeros((0, NUMBER))) is health


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda _: SkinHealth.fit(recording(0)[:10]), "too few"),
        (lambda _: SkinHealth.fit(np.zeros((100, 4))), "every channel"),
        (lambda _: SkinHealth.fit(np.full((100, 4), np.nan)), "every channel"),
        (lambda _: SkinHealth.fit(np.zeros(100)), "healthy must be"),
        (lambda _: SkinHealth.fit(recording(0), np.zeros(600)), "times must increase"),
        (lambda _: SkinHealth.fit(recording(0), np.arange(9.0)), "times"),
        (lambda _: SkinHealth.fit(recording(0), patience=-1.0), "patience"),
        (lambda _: SkinHealth.fit(recording(0), protocol=two_terminal(5)), "protocol"),
        (lambda health: health.follow(np.nan, REST), "time"),
        (lambda health: health.follow(0.0, REST[:-1]), "channels"),
        (lambda health: health.follow(0.0, ["a"] * NUMBER), "frame"),
        (lambda health: watch(health, REST), "frames must be"),
        (lambda health: health.repaired(np.full((3, NUMBER), np.nan)), "no reference"),
        (lambda health: health.repaired(np.zeros((3, 4))), "channels"),
        (lambda health: health.confirm("it"), "event"),
    ],
)
def test_bad_input_is_refused(health, ask, message):
    with pytest.raises(ValueError, match=message):
        ask(health)
