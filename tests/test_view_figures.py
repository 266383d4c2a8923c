"""Static figures: what they draw from which arrays, and the line of text under them."""

from xml.etree import ElementTree

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image

from cmc.store import asset
from cmc.view import figures, style


@pytest.fixture(autouse=True)
def closed():
    with mpl.rc_context({"backend": "agg"}):
        yield
    plt.close("all")


def spiral(number=6):
    t = np.linspace(0, 5, 80)
    angle = 2 * t[:, None] + np.linspace(0, 6, number)
    radius = np.exp(-0.5 * t)[:, None] * np.linspace(0.5, 2, number)
    return t, np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def drawn():
    t, paths = spiral()
    rng = np.random.default_rng(0)
    return {
        "trajectories": figures.trajectories(t, paths[..., 0], name="bundle", target=0.0),
        "distances": figures.trajectories(t, np.exp(-t), log=True),
        "matrix": figures.matrix(np.eye(4), block=2, labels=list("abcd"), title="$F$"),
        "matrices": figures.matrices({"$R$": np.eye(2), "$F$": np.ones((4, 4))}),
        "curves": figures.curves(t, {"a": t + 1, "b": t**2 + 1}, labels=("t (s)", "y"), log="xy"),
        "histogram": figures.histogram({"a": rng.normal(size=99)}, label_x="error (N)"),
        "region": figures.region(t, t[:5], rng.normal(size=(5, 80)), labels=("a", "b", "c")),
    }


def test_every_figure_is_drawn_inside_its_frame_with_labels(tmp_path):
    """Not blank, nothing of it (labels included) touches the edge; its description is inside."""
    for name, figure in drawn().items():
        for ax in figure.axes:
            if ax.axison and len(ax.get_xticks()) and not name.startswith("matri"):
                assert ax.get_xlabel() or ax.get_ylabel(), name
        file = figures.save(figure, tmp_path / "figure.png", name)
        pixels = imread(file)[..., :3]
        assert pixels.std() > 0.02, name
        edge = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
        assert edge.min() > 0.98, f"{name} is cut off"
        assert Image.open(file).text["Description"] == name
    assert plt.get_fignums() == []


@pytest.fixture
def shown(monkeypatch):
    pictures = []
    monkeypatch.setattr("IPython.get_ipython", lambda: object())
    monkeypatch.setattr("IPython.display.display", lambda bundle, raw: pictures.append(bundle))
    return pictures


def test_describe_shows_the_picture_with_its_line_and_closes_it(shown):
    figure = figures.trajectories([0, 1], [1, 2])
    figures.describe(figure, 'A line rises from 1 to 2: "fast" & <steep>.')
    (bundle,) = shown
    words = "A line rises from 1 to 2: &quot;fast&quot; &amp; &lt;steep&gt;."
    assert f'alt="{words}"' in bundle["text/html"]
    assert "<figcaption" in bundle["text/html"]
    assert bundle["text/plain"] == 'Figure: A line rises from 1 to 2: "fast" & <steep>.'
    assert plt.get_fignums() == []


def schematics():
    return sorted(file.stem for file in asset("schematics").glob("*.svg"))


@pytest.mark.parametrize("name", schematics())
def test_a_schematic_is_shown_with_a_line(name, shown):
    """It is well-formed, has a title, draws something, holds no script and loads nothing."""
    figures.schematic(name, "What it shows.")
    (bundle,), data = shown, (asset("schematics") / f"{name}.svg").read_bytes()
    root = ElementTree.fromstring(data)
    assert root.findtext("{*}title").endswith(".")
    tags = [node.tag.split("}")[-1] for node in root.iter()]
    assert tags.count("path") > 5
    assert not set(tags) & {"script", "image", "a"}
    assert b'href="http' not in data
    assert 'alt="What it shows."' in bundle["text/html"]
    assert "data:image/svg+xml;base64" in bundle["text/html"]


def deuteranope(colors):
    """Colors as seen when red and green look the same."""
    # Vienot, Brettel, Mollon (1999), on linear RGB.
    seen = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1]])
    rgb = np.array([mpl.colors.to_rgb(c) for c in colors])
    return np.clip(rgb**2.2 @ seen.T, 0, 1) ** (1 / 2.2)


def test_colors_stay_apart_in_gray_and_for_the_color_blind():
    """Any two of the first six differ clearly, also when red and green look the same."""
    seen = deuteranope(figures.CYCLE[:6])
    apart = np.linalg.norm(seen[:, None] - seen[None], axis=-1) + np.eye(6)
    assert apart.min() > 0.12


def test_a_method_has_one_color_and_line_wherever_it_is_drawn():
    """By its name, its title, or a longer label; other labels get colors that are still free."""
    blue, orange = figures.METHOD_COLORS["ctd3"], figures.METHOD_COLORS["td3"]
    lines = {"TD3/TD3, plain critic, 200k": [1, 2], "other": [1, 1], "C-TD3": [2, 1]}
    drawn = figures.curves([0, 1], lines, labels=("x", "y")).axes[0].get_lines()
    assert [line.get_color() for line in drawn] == [orange, figures.CYCLE[2], blue]
    assert [line.get_linestyle() for line in drawn] == ["--", "-", "-"]
    assert style._method_of("TD3/C-TD3, the paper's scheme") == "ctd3_paper"


def test_titles_are_those_of_the_studies():
    from cmc import studies

    for study in ("peg_touch", "peg_maze", "peg_push"):
        methods = studies.get(study).methods
        assert {n: m.title for n, m in methods.items()}.items() <= figures.METHOD_TITLES.items()


def test_methods_of_one_study_differ_in_more_than_red_and_green():
    """Seen by a deuteranope, two methods with one line style never have one color."""
    names = list(style.METHODS)
    two_levels = names.index("cppo")
    for study in (names[:two_levels], names[two_levels:]):
        for line in {row["line"] for row in style.METHODS.values()}:
            same = [n for n in study if style.METHODS[n]["line"] == line]
            seen = deuteranope([figures.METHOD_COLORS[n] for n in same])
            apart = np.linalg.norm(seen[:, None] - seen[None], axis=-1) + np.eye(len(same))
            assert apart.min() > 0.08, same


def test_zero_entries_are_written_as_zero_and_stay_white():
    F = np.array([[2.0, 1e-14], [-1.0, 0.5]])
    figure = figures.matrix(F)
    assert [t.get_text() for t in figure.axes[0].texts] == ["2", "0", "-1", "0.5"]


def test_a_histogram_counts_every_sample():
    figure = figures.histogram(
        {"a": [-50.0, 0.1, 0.2, 99.0]}, label_x="e", bins=np.linspace(-1, 1, 5)
    )
    heights = [p.get_data().values for p in figure.axes[0].patches]
    np.testing.assert_allclose(heights[-1], [0.25, 0.0, 0.5, 0.25])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: figures.matrix(np.zeros(3)), r"wanted a matrix \(rows, columns\)"),
        (lambda: figures.matrices({}), "at least one matrix"),
        (
            lambda: figures.region([0, 1], [0, 1], np.zeros((3, 2)), labels=("", "", "")),
            "got shape",
        ),
        *[
            (
                lambda text=text: figures.describe(figures.trajectories([0, 1], [1, 2]), text),
                "one line",
            )
            for text in ("", "  ", "two\nlines")
        ],
        (lambda: figures.schematic("serial", "d"), "no schematic 'serial'; there are"),
    ],
)
def test_bad_input_is_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_the_style_leaves_other_figures_to_the_reader():
    """Importing sets nothing; a figure of the course does."""
    with mpl.rc_context():
        mpl.rcdefaults()
        figures.panels()
        assert mpl.rcParams["axes.prop_cycle"].by_key()["color"] == list(figures.CYCLE)
