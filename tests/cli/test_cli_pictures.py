"""Pictures that commands draw: formats, levels, colours and borders."""

import numpy as np
import pytest
from cases import along_x, lines_over
from click.testing import CliRunner

import clsas
from clsas.cli import main
from clsas.engine.data.grid import Grid

pytest.importorskip("matplotlib")

LINES = lines_over(
    Grid.plane((-1, 1, 40), (20, 22, 33)), along_x(32, 0.05), carrier_hz=1e5, step_m=0.01
)
GRID = ("--x", "-1:1:40", "--y", "20:22:33")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    clsas.save(tmp_path / "lines.h5", LINES)
    (tmp_path / "scene.toml").write_text(
        "[grid]\nx = { start_m = -1, stop_m = 1, count = 40 }\n"
        "y = { start_m = 20, stop_m = 22, count = 33 }\n"
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*args, code=0):
    result = CliRunner().invoke(main, [str(arg) for arg in args], prog_name="clsas")
    assert result.exit_code == code, result.output
    return result.output


@pytest.mark.slow
@pytest.mark.parametrize(("name", "start"), [("a.pdf", b"%PDF"), ("a.svg", b"<?xml")])
def test_the_suffix_decides_the_format(folder, name, start):
    run("image", "lines.h5", *GRID, "-o", "image.h5", "--picture", name)
    assert (folder / name).read_bytes().startswith(start)


@pytest.mark.slow
def test_levels_and_colours_of_an_image(folder, figures):
    run("image", "lines.h5", *GRID, "-o", "a.h5", "--picture", "a.png", "--dynamic-range-db", 30)
    run(
        "image", "lines.h5", *GRID, "-o", "b.h5", "--picture", "b.png",
        "--percentiles", "5:99", "--colour-map", "sonar",
    )  # fmt: skip
    one, other = (figure.axes[0].get_images()[0] for figure in figures)
    assert one.get_clim() == (-30, 0)
    assert (one.get_cmap().name, other.get_cmap().name) == ("inferno", "sonar")
    level = clsas.load("b.h5").db()
    np.testing.assert_allclose(other.get_clim(), np.percentile(level, (5, 99)), atol=1e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--percentiles", "99"), "'99' must be LOW:HIGH, two numbers"),
        (("--percentiles", "99:1"), "must be two ascending numbers in % from 0 to 100, got 99:1"),
        (("--percentiles", "1:99", "--dynamic-range-db", 40), "exclude each other"),
        (("--colour-map", "sonnar"), "--colour-map must be 'sonar' or one of matplotlib's"),
    ],
)
def test_bad_levels_and_colours_are_refused_before_any_work(folder, options, words):
    for command in (
        ("image", "lines.h5", *GRID, "-o", "image.h5"),
        ("mosaic", "scene.toml", "--lines", "lines.h5"),
    ):
        assert words in " ".join(run(*command, "--picture", "a.png", *options, code=2).split())
    assert {path.name for path in folder.iterdir()} == {"lines.h5", "scene.toml"}


@pytest.mark.slow
def test_borders_of_patches_on_request(folder, figures):
    pytest.importorskip("zarr")
    command = ("mosaic", "scene.toml", "--lines", "lines.h5", "--patches", "2x3")
    run(*command, "--picture", "a.png")
    run(*command, "--picture", "b.png", "--borders")
    assert [len(figure.axes[0].get_lines()) for figure in figures] == [0, 3]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["image", "mosaic"])
def test_grids_of_scene_files(folder, command):
    """Slanted planes and height maps, as the library makes them."""
    if command == "mosaic":
        pytest.importorskip("zarr")
    heights = np.linspace(-0.1, 0.1, 33 * 40).reshape(33, 40)
    np.save("heights.npy", heights)
    plain = (folder / "scene.toml").read_text()
    slanted = (
        "[grid]\norigin_m = [-1, 20, 0]\nrow_step_m = [0, 0.06, 0.01]\n"
        "column_step_m = [0.05, 0, 0]\nshape = [33, 40]\n"
    )
    slope = Grid.oriented([-1, 20, 0], [0, 0.06, 0.01], [0.05, 0, 0], (33, 40))
    with_heights = "height_file = 'heights.npy'\n"
    relief = Grid.plane((-1, 1, 40), (20, 22, 33)).with_height(heights)
    for number, (table, grid) in enumerate(
        [
            (plain.replace("[grid]\n", f"[grid]\n{with_heights}"), relief),
            (slanted, slope),
            (slanted + with_heights, slope.with_height(heights)),
        ]
    ):
        (folder / "grid.toml").write_text(table)
        if command == "image":
            run("image", "lines.h5", "--scene", "grid.toml", "--exact", "-o", "i.h5",
                "--picture", "i.png")  # fmt: skip
            formed = clsas.load("i.h5")
        else:
            store = f"{number}.zarr"
            run("mosaic", "grid.toml", "--lines", "lines.h5", "--exact", "-o", store)
            formed = clsas.Store.opened(store).image()
        np.testing.assert_allclose(formed.grid.positions_m(), grid.positions_m(), atol=1e-12)
        assert clsas.relative_error_db(formed, clsas.backproject(LINES, grid)) < -55
