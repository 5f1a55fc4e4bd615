"""The viewer in a headless Chromium: what a user sees, clicks and types."""

import re
import shutil
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from chromium import PROGRAM, Chromium

import clsas
from clsas.engine.data.image import Formed
from clsas.maps import viewer

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no Chromium: apt-get install chromium")

GRID = clsas.Grid.plane((-12, 11.98, 1200), (40, 55.98, 800))
BRIGHT = [(-4.0, 50.0), (6.0, 50.0)]  # m; 10 m apart
BACKGROUND_DB = -30


def pixels_with(background_db):
    pixels = np.full(GRID.shape, 10 ** (background_db / 20), np.complex64)
    for x, y in BRIGHT:
        pixels[round((y - 40) / 0.02), round((x + 12) / 0.02)] = 1j
    pixels[:40] = 0  # nothing was received
    return clsas.Image(pixels, GRID)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Chromium(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


FORMED = Formed("factorized", -40, "<b>4 taps</b>", -41.2, None, (), "GPU", "1", "a")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("viewer") / "web"
    images = [pixels_with(BACKGROUND_DB), pixels_with(BACKGROUND_DB - 15.2)]
    images[1] = replace(images[1], formed=FORMED)
    names = ["exact </script><b>", "tolerance"]
    viewer.write(images[0], path, against=images[1], names=names, colour_map="gray")
    return path


@pytest.fixture
def page(browser, folder):
    browser.errors.clear()
    browser.open(folder / "index.html")
    yield browser
    assert browser.errors == []  # nor was anything asked of a network


def colour(page, x, y):
    """Colour that the page shows at a place."""
    from matplotlib.image import imread

    return np.rint(255 * imread(BytesIO(page.screenshot()))[y, x, :3]).astype(int).tolist()


def gray(level_db, low=-60, high=0):
    """The colour of a level, which tiles have to half a step of 0.4 dB."""
    level_db = 0.4 * round(level_db / 0.4)
    return [round(255 * min(max((level_db - low) / (high - low), 0), 1))] * 3


def go(page, x, y):
    page.press("g")
    page.js("document.querySelector('#place').value = ''")
    page.type(f"{x}, {y}")
    page.press("Enter")


def position(page):
    x, y = re.fullmatch(r"x (\S+) m, y (\S+) m", page.text("#cursor")).groups()
    return float(x.replace("−", "-")), float(y.replace("−", "-"))


def pixels_per_metre(page):
    """The scale that the scale bar shows."""
    width = page.js("parseFloat(document.querySelector('#scale-bar').style.width)")
    return width / float(page.text("#scale-length").removesuffix(" m"))


def test_a_known_point_is_where_the_cursor_says(page):
    for point in BRIGHT:
        go(page, *point)
        assert position(page) == pytest.approx(point, abs=1e-3)
        assert page.text("#level") == "0.0 dB"
    width, height = page.js("[innerWidth, document.querySelector('#view').clientHeight]")
    # With the mouse, at the pixel in the middle and at one beside it, of 4 x 4 of the screen.
    page.move(width // 2, height // 2)
    assert position(page) == pytest.approx(BRIGHT[1], abs=0.011)
    assert page.text("#level") == "0.0 dB"
    page.move(width // 2 + 6, height // 2)
    assert position(page)[0] == pytest.approx(BRIGHT[1][0] + 0.03, abs=0.011)
    assert float(page.text("#level")[:-3].replace("−", "-")) == pytest.approx(-30, abs=0.2)


def test_the_panel_says_how_the_image_was_formed(page):
    assert page.text("#formed") == ""
    page.press("2")
    assert page.text("#formed") == FORMED.describe()
    page.press("s")
    assert page.text("#formed") == FORMED.describe()


def test_wheel_and_drag_move_what_is_under_the_pointer(page):
    page.move(500, 300)
    before = position(page)
    page.call("Input.dispatchMouseEvent", type="mouseWheel", x=500, y=300, deltaX=0, deltaY=-960)
    page.settle()
    page.move(500, 300)
    assert position(page) == pytest.approx(before, abs=2e-3)
    for kind, x, y in (
        ("mousePressed", 500, 300),
        ("mouseMoved", 440, 350),
        ("mouseReleased", 440, 350),
    ):
        page.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)
    page.settle()
    assert position(page) == pytest.approx(before, abs=2e-3)


@pytest.mark.slow
def test_levels_and_colours_change_the_pixels(page):
    go(page, 0, 45)  # in the background
    assert colour(page, 300, 300) == gray(BACKGROUND_DB)
    for slider, value, limits in (("low", -40, (-40, 0)), ("high", -20, (-40, -20))):
        page.js(
            f"(slider => {{ slider.value = {value}; slider.dispatchEvent(new Event('input')); }})"
            f"(document.querySelector('#{slider}'))"
        )
        page.settle()
        assert colour(page, 300, 300) == gray(BACKGROUND_DB, *limits)
    page.press("m")
    red, green, blue = colour(page, 300, 300)
    assert red > max(green, blue)  # inferno
    assert page.js("document.querySelector('#colours').value") == "inferno"
    page.press("r")
    assert page.text("#low-db") == "−60.0 dB"
    page.press("a")  # of a constant background
    assert page.text("#low-db") == "−30.0 dB"
    assert page.text("#high-db") == "−29.0 dB"


@pytest.mark.slow
def test_distances_with_keys_and_mouse(page):
    page.press("d")
    for point in BRIGHT:
        go(page, *point)
        page.press("Enter")
    assert page.text("#distance") == "10.000 m (Δx 10.000, Δy 0.000 m)"
    page.press("0")
    ends = []
    for x, y in ((300, 300), (600, 200)):
        page.click(x, y)
        ends.append(position(page))
    length_m = float(page.text("#distance").split()[0])
    assert length_m == pytest.approx(np.hypot(*np.subtract(*ends)), abs=3e-3)
    page.press("Escape")
    assert page.text("#distance") == ""


@pytest.mark.slow
def test_two_images_swiped_and_blinked(page):
    go(page, 0, 45)
    middle = page.js("innerWidth / 2")
    assert page.text("#name-0") == "exact </script><b>"
    page.press("2")
    assert page.text("#name-0") == "tolerance"
    assert colour(page, 300, 300)[0] == pytest.approx(gray(BACKGROUND_DB - 15.2)[0], abs=1)
    page.press("s")
    assert [page.text(f"#name-{i}") for i in (0, 1)] == ["exact </script><b>", "tolerance"]
    assert colour(page, int(middle) - 40, 100) == gray(BACKGROUND_DB)
    assert colour(page, int(middle) + 40, 100)[0] == pytest.approx(
        gray(BACKGROUND_DB - 15.2)[0], abs=1
    )
    for _ in range(5):
        page.press(".")
    assert colour(page, int(middle) + 40, 100) == gray(BACKGROUND_DB)
    page.press("b")
    page.wait_until("document.querySelector('#name-0').textContent === 'tolerance'")
    page.wait_until("document.querySelector('#name-0').textContent !== 'tolerance'")


@pytest.mark.slow
def test_the_address_keeps_the_view(page, folder):
    go(page, *BRIGHT[0])
    page.press("[")
    page.wait_until("location.hash.includes('low=-61')")
    address = page.js("location.hash")
    page.open(folder / "index.html", address=address)
    assert page.text("#low-db") == "−61.0 dB"
    page.press("+")  # the middle of the view, at the cross
    assert position(page) == pytest.approx(BRIGHT[0], abs=2e-3)


@pytest.mark.parametrize(
    ("address", "low", "high"),
    [
        ("#colours=constructor", -60, 0),
        ("#low=5&high=10", -1, 0),
        ("#low=-300&high=-200", -101, -100),
        ("#low=-3.0&high=-2.9", -3.9, -2.9),
        ("#low=-3&high=Infinity", -60, 0),
    ],
)
def test_a_wrong_address_is_brought_within_limits(page, folder, address, low, high):
    page.open(folder / "index.html", address=address)
    found = [page.text(f"#{end}-db").replace("−", "-") for end in ("low", "high")]
    assert found == [f"{low:.1f} dB", f"{high:.1f} dB"]
    assert page.js("document.querySelector('#colours').value") == "gray"


def test_an_address_far_away_ends_beside_the_image(page, folder):
    page.open(folder / "index.html", address="#u=1e300&v=-1e300&scale=1e300")
    u, v = page.js("[view.u, view.v]")
    assert abs(u) < 50
    assert abs(v) < 100


@pytest.mark.slow
def test_fits_a_narrow_window(page, folder):
    page.open(folder / "index.html", width=400, height=700)
    assert page.js("document.querySelector('#panel').hidden")
    page.press("c")
    assert page.js("document.documentElement.scrollWidth") == 400
    outside = """[...document.querySelectorAll('button, input, select, output, footer span')]
    .filter(each => {
        const box = each.getBoundingClientRect();
        return box.width && (box.left < 0 || box.right > innerWidth || box.bottom > innerHeight);
    }).map(each => each.id)"""
    assert page.js(outside) == []
    go(page, *BRIGHT[0])
    assert position(page) == pytest.approx(BRIGHT[0], abs=1e-3)
    assert page.js(outside) == []


@pytest.mark.slow
def test_two_fingers_zoom_about_their_middle(page, folder):
    page.open(folder / "index.html", width=400, height=700)
    page.move(200, 300)
    before = position(page)
    scale = pixels_per_metre(page)
    for kind, apart in (("touchStart", 40), ("touchMove", 100), ("touchMove", 160)):
        fingers = [{"x": 200 + side * apart / 2, "y": 300, "id": side} for side in (-1, 1)]
        page.call("Input.dispatchTouchEvent", type=kind, touchPoints=fingers)
    page.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    page.settle()
    assert pixels_per_metre(page) / scale == pytest.approx(4, rel=1e-3)
    page.move(200, 300)
    assert position(page) == pytest.approx(before, abs=0.02)


def test_the_scale_bar_has_the_scale_of_the_image(page):
    page.press("9")  # one pixel of the screen for each of the image: 2 cm
    assert page.text("#scale-length") == "2 m"
    assert pixels_per_metre(page) == pytest.approx(50, rel=1e-6)


@pytest.mark.slow
def test_a_slanted_grid_with_a_georeference_and_patches(browser, tmp_path, monkeypatch):
    """Steps of 3 and 2 cm, turned by 30 degrees; degrees as if Earth were flat."""
    turn = np.radians(30)
    along, across = (np.cos(turn), np.sin(turn), 0), (-np.sin(turn), np.cos(turn), 0)
    grid = clsas.Grid.oriented(
        (500000.0, 6.7e6, 0), 0.03 * np.array(across), 0.02 * np.array(along), (600, 700),
        georeference=clsas.Georeference.local(60, -5, heading_deg=90),
    )  # fmt: skip
    pixels = np.full(grid.shape, 0.1, np.complex64)
    pixels[400, 100] = 1

    def to_geographic(positions_m):
        return np.stack(
            [60 + (positions_m[..., 1] - 6.7e6) / 1e5, -5 + positions_m[..., 0] / 1e7], -1
        )

    monkeypatch.setattr(
        clsas.Georeference, "to_geographic", lambda _, positions_m: to_geographic(positions_m)
    )
    monkeypatch.setattr(viewer, "_patches", lambda _: [[300, 0, 300, 350, -42.1, -44.0, "a gap"]])

    class Stub(clsas.Store):
        patch_shape = (300, 350)
        records = staticmethod(dict)

        def read(self, rows, columns):
            return pixels[rows, columns]

    monkeypatch.setattr(Stub, "grid", grid)
    viewer.write(Stub(tmp_path / "a.zarr"), tmp_path / "web")
    browser.errors.clear()
    browser.open(tmp_path / "web" / "index.html")
    x, y, _ = grid.positions_m()[400, 100]
    go(browser, f"{x:.4f}", f"{y:.4f}")
    browser.press("p")
    assert position(browser) == pytest.approx((x, y), abs=2e-3)
    assert browser.text("#level") == "0.0 dB"
    latitude, longitude = to_geographic(np.array([x, y, 0]))
    expected = f"{latitude:.7f}° N, {-longitude:.7f}° W"
    found = browser.text("#geographic")
    assert [float(n) for n in re.findall(r"[\d.]+", found)] == pytest.approx(
        [float(n) for n in re.findall(r"[\d.]+", expected)], abs=2e-7
    )
    assert re.fullmatch(r"\S+ N, \S+ W", found)
    assert browser.text("#patch") == "predicted error −42.1 dB, measured −44.0 dB, a gap"
    # The rows of the grid point up on the screen, so that north is 30 degrees to the right of it.
    north = "document.querySelector('#north svg').style.transform"
    assert float(browser.js(north)[7:-4]) == pytest.approx(30, abs=0.5)
    assert browser.errors == []


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["removed", "empty", "cut"])
def test_missing_tiles_are_named(browser, folder, tmp_path, damage):
    shutil.copytree(folder, tmp_path / "web")
    browser.open(tmp_path / "web" / "index.html")
    assert browser.text("#missing") == ""
    for path in (tmp_path / "web" / "tiles").rglob("*.js"):
        if damage == "removed":
            path.unlink()
        else:
            name = path.relative_to(tmp_path / "web" / "tiles").with_suffix("").as_posix()
            path.write_text("" if damage == "empty" else f'clsasTile("{name}","AA==");')
    browser.open(tmp_path / "web" / "index.html")
    browser.move(500, 300)
    browser.settle()
    assert browser.text("#missing") == "tile missing: copy the whole folder"
    assert browser.text("#level") == "missing"


def test_a_level_is_loading_before_its_tile_has_come(page):
    page.move(500, 300)
    page.js("tiles.forEach(tile => { tile.levels = null; })")
    page.js("showReadout()")
    assert page.text("#level") == "loading"


def test_an_incomplete_copy_says_what_is_missing(browser, folder, tmp_path):
    for path in folder.iterdir():
        if path.is_file() and path.name != "scene.js":
            (tmp_path / path.name).write_bytes(path.read_bytes())
    browser.call("Page.navigate", url=(tmp_path / "index.html").as_uri())
    browser.wait_until("document.readyState === 'complete'")  # later scripts fail for want of it
    assert "copy the whole folder" in browser.text("#trouble")


@pytest.mark.slow
def test_rows_stay_apart_where_columns_are_far_closer(browser, tmp_path):
    """Rows of 1 m with columns of 1 mm: seen as a whole, pixels are 10 dots high."""
    rows, columns = 30, 20_000
    grid = clsas.Grid.plane((0, 19.999, columns), (0, 29, rows))
    pixels = np.full((rows, columns), 1e-3, np.complex64)
    pixels[::2] = 1.0
    viewer.write(clsas.Image(pixels, grid), tmp_path / "web", colour_map="gray")
    browser.errors.clear()
    browser.open(tmp_path / "web" / "index.html")
    for row in (10, 11, 12):
        x, y = browser.js(f"toScreen(...toPlane({columns // 2}, {row})).map(Math.round)")
        gray_level = colour(browser, x, y)[0]  # rows are smoothed a little, with their columns
        assert gray_level > 240 if row % 2 == 0 else gray_level < 15
    assert browser.errors == []
