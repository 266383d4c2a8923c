"""What lesson 00 computes."""

import importlib.metadata

import numpy as np
import pytest

from cmc.lessons import lesson_00


def test_the_installation_names_every_package_or_what_to_do(monkeypatch):
    lines = lesson_00.installation().splitlines()
    assert [line.split()[0] for line in lines] == ["cmc", *lesson_00.PACKAGES]
    assert f"numpy {np.__version__}" in lines

    def absent(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(lesson_00.metadata, "version", absent)
    with pytest.raises(ImportError, match="numpy is not installed: run  make course"):
        lesson_00.installation()


def test_the_target_is_a_closed_figure_of_eight():
    t = np.linspace(0, 5 * np.pi, 801)
    path = lesson_00.target(t)
    np.testing.assert_allclose(path[0], path[-1], atol=1e-12)
    np.testing.assert_allclose(path[400], [0, 0], atol=1e-12)  # it crosses itself half way
    np.testing.assert_allclose(path + path[::-1], 0.0, atol=1e-12)


def test_positive_networks_agree_and_networks_of_any_sign_need_not():
    loops = lesson_00.random_networks(number=12, starts=4)
    assert loops["any"].shape == loops["positive"].shape == (501, 12, 4, 2)
    np.testing.assert_array_equal(loops["any"][0], loops["positive"][0])
    assert (loops["apart_positive"] < 1e-3).all()
    assert (loops["apart_any"] > 0.1).mean() > 0.5
    gaps = np.linalg.norm(loops["any"][-1, :, 0] - loops["any"][-1, :, 1], axis=-1)
    assert (gaps <= loops["apart_any"] + 1e-12).all()


@pytest.mark.parametrize(("slope", "memory"), [(1.0, 1.0), (4.0, 0.5), (-2.0, 1.0), (1.0, -1.0)])
def test_distances_decay_at_the_rate_that_is_shown(slope, memory):
    picture = lesson_00.forgetting(slope, memory)
    late = picture["distance"][-60:].max(axis=1)
    t = picture["t"][-60:]
    if np.abs(picture["eig"].imag).max() < 1e-9:
        measured = -np.polyfit(t, np.log(late), 1)[0]
        assert measured == pytest.approx(picture["rate"], rel=0.1)
    else:
        assert (late[-1] > late[0]) == (picture["rate"] < 0)
    assert ("forget" in picture["text"]) == (picture["rate"] > 0)
