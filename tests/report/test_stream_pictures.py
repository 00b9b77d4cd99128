"""Pictures of a stream: a contact sheet and a film with one colour scale, in which refused frames are marked."""

import numpy as np
import pytest
from PIL import Image

from jeit.electrodes import BoundaryElectrodes
from jeit.layout import ring
from jeit.mesh import Disk, Solid, centroids
from jeit.plot import plot_frames
from jeit.plot.imaging.series import select_frames
from jeit.report import series, write_film

RADIUS = 0.05
MESH = Disk(RADIUS).mesh(num_points=200)
ELECTRODES = BoundaryElectrodes(ring(RADIUS, 8), 0.01, 0.1)


def changes(number: int, refused: tuple[int, ...] = ()) -> np.ndarray:
    """A spot that moves in a circle, twice as strong in the last frame."""
    angle = np.linspace(0, 5, number)
    place = 0.025 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    away = np.linalg.norm(np.asarray(centroids(MESH)) - place[:, None], axis=-1)
    values = 1e-3 * np.exp(-((away / 0.01) ** 2))
    values[-1] *= 2
    values[list(refused)] = np.nan
    return values


def pictures(figure):
    """Axes with an image, except those of colour bars."""
    return [ax for ax in figure.axes if ax.get_title()]


def test_chosen_frames_are_evenly_spaced_with_both_ends():
    assert select_frames(5, 12) == [0, 1, 2, 3, 4]
    assert select_frames(100, 4) == [0, 33, 66, 99]


def test_a_contact_sheet_has_one_scale_times_and_refusals():
    titles = [f"{0.1 * k:.1f} s" for k in range(30)]
    figure = plot_frames(MESH, changes(30, (0, 4)), ELECTRODES, titles=titles)
    shown = pictures(figure)
    assert [ax.get_title() for ax in shown] == [titles[k] for k in select_frames(30, 12)]
    assert {ax.images[1].get_clim() for ax in shown} == {shown[0].images[1].get_clim()}
    assert shown[0].images[1].get_clim()[1] == pytest.approx(2, rel=0.1)  # mS: of all frames, the last is strongest
    assert [ax.images[1].get_visible() for ax in shown] == [False] + 11 * [True]
    marked = [[text.get_visible() for text in ax.texts if text.get_text() == "refused"] for ax in shown]
    assert marked == [[True], *11 * [[False]]]
    assert figure.get_supxlabel() == "12 of 30 frames; 2 of 30 refused: 0.0 s, 0.4 s"
    assert any("mS" in ax.get_ylabel() for ax in figure.axes)  # the colour bar
    bars = [text.get_text() for text in shown[0].texts]
    assert "20 mm" in bars
    np.testing.assert_allclose(np.nanmax(shown[-1].images[1].get_array()), 2, rtol=0.1)


def test_a_solid_is_cut_at_half_its_height():
    mesh = Solid(Disk(RADIUS), 0.04).mesh(num_points=600)
    figure = plot_frames(mesh, np.ones((2, mesh.num_cells)))
    assert figure.get_supxlabel() == "slices at z = 20.0 mm"


@pytest.mark.parametrize(
    ("given", "options", "message"),
    [
        (np.ones((3, 7)), {}, "changes has shape"),
        (changes(3), {"titles": ["a"]}, "titles are 1, and the frames 3"),
        (changes(2, (0, 1)), {}, "every frame was refused"),
    ],
)
def test_bad_input(given, options, message):
    with pytest.raises(ValueError, match=message):
        plot_frames(MESH, given, **options)


def test_a_film_has_every_frame_at_the_rate_of_the_stream(tmp_path):
    reported = []
    write_film(tmp_path / "a.gif", MESH, changes(6, (2,)), ELECTRODES, rate=5.0, progress=reported.append)
    with Image.open(tmp_path / "a.gif") as shown:
        assert (shown.n_frames, shown.info["duration"]) == (6, 200)
        assert max(shown.size) <= 400
        frames = []
        for number in range(6):
            shown.seek(number)
            frames.append(np.asarray(shown.convert("RGB")).astype(int))
    red = [int((frame[..., 0] - frame[..., 2] > 100).sum()) for frame in frames]
    assert red[2] < min(red[:2] + red[3:])  # no image is left where a frame was refused
    assert reported == [f"{k} of 6" for k in range(1, 7)]
    assert (tmp_path / "a.gif").stat().st_size < 300_000


def test_films_of_long_streams_are_short(tmp_path, monkeypatch):
    monkeypatch.setattr(series, "FILM_FRAMES", 4)
    write_film(tmp_path / "a.gif", MESH, changes(40), rate=1000.0)
    with Image.open(tmp_path / "a.gif") as shown:
        assert (shown.n_frames, shown.info["duration"]) == (4, 40)  # no faster than 25 a second
    monkeypatch.setattr(series, "FILM_FRAMES", 2)
    write_film(tmp_path / "b.gif", MESH, changes(40), rate=50.0)
    with Image.open(tmp_path / "b.gif") as shown:
        assert (shown.n_frames, shown.info["duration"]) == (2, 400)  # as long as the stream, 0.8 s


def test_a_film_of_a_solid_states_the_planes_of_its_slices(tmp_path, monkeypatch):
    labels = []
    monkeypatch.setattr("matplotlib.figure.Figure.supxlabel", lambda _, text, **__: labels.append(text))
    solid = Solid(Disk(RADIUS), 0.04).mesh(num_points=600)
    write_film(tmp_path / "a.gif", solid, np.ones((1, solid.num_cells)))
    write_film(tmp_path / "b.gif", MESH, changes(2))
    assert labels == ["slice at z = 20.0 mm"]
    with Image.open(tmp_path / "b.gif") as shown:
        assert (shown.n_frames, shown.info["duration"]) == (2, 100)  # of a stream without a rate


def test_unknown_kinds_of_films_are_refused(tmp_path, monkeypatch):
    from matplotlib.animation import FFMpegWriter

    for name in ("a.avi", "there/a.gif"):
        with pytest.raises(ValueError, match=r"film must be a name that ends in \.gif or \.mp4; it is"):
            series.check_film(name)
    monkeypatch.setattr(FFMpegWriter, "isAvailable", classmethod(lambda cls: False))
    with pytest.raises(ValueError, match=r"'a\.mp4' needs ffmpeg, which is not installed; name it \.gif"):
        write_film(tmp_path / "a.mp4", MESH, changes(2))
