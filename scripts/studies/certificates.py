"""How certificates scatter, and which images that miss their tolerances they find.

Random scenes of the families in tests/families.py are imaged exactly and factorized, as by
scripts/attack/scenes. A float64 sum that shares nothing with the library gives the ideal image at
some thousand pixels of each. The true error of the image of these pixels is therefore known, and
draws of pixels can be repeated by the library's own code without forming any pixel again.

Bounds and verdicts are judged after 64, 256 and 1024 pixels, and after the rule that draws more
pixels while an image is undecided: for images that take so little time that no more than 64 pixels
are affordable, and for those that take so long that any number is.

Scenes whose error cannot be measured are printed, as are images of which the certificate's own
sums, at all pixels, give another error than the oracle.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from fewer_colours import with_fewer_colours
from matplotlib.figure import Figure
from numpy.typing import NDArray

import clsas
from clsas.engine.certificate import Measurement
from clsas.engine.data.certificate import Certificate
from clsas.engine.device.device import Device, open_device
from clsas.engine.promise import more_pixels
from clsas.selftest import oracle

PIXELS = {False: 4000, True: 450}  # that are known; fewer where sound speed varies: rays are slow
DRAWS = 10
LONG, SHORT = (64, 256, 512, 1024), (64, 128, 256, 512, 1024)  # pixels after each round
FIXED = (64, 256, 1024)
COLUMNS = ("%", *(f"{count} pixels" for count in FIXED), "64 to 1024", "256 to 1024")
EXCESS_DB = (-3.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
AGREE_DB = 1.0  # to which the certificate's sums and the oracle give the error of an image
TRUSTED_DB = -85.0  # no better images are promised
ACCURACIES_DB = (-30.0, -50.0, -70.0)
TOLERANCES_DB = (-15.0, -20.0, -30.0, -40.0, -50.0, -60.0, -70.0)
WRONG_DB = (0.0, 20.0, 40.0)  # power of a single wrong pixel, relative to the mean
OF_PIXELS = 10**6
NEAR_DB = (-1.0, 0.0, 1.0)
MISSED_DB = (0, 1, 2)
UPPER, LOWER = "true error at most `upper_db`", "true error at least `lower_db`"
UNDECIDED = "undecided, with the image's tolerance"
TESTS = str(Path(__file__).parents[2] / "tests")


def within(least_db: int, kind: str) -> str:
    return f"estimate within {least_db} dB{kind}"


def near(excess_db: float) -> str:
    return f", {excess_db:+g} dB from the tolerance"


def of_own(least_db: int | None) -> str:
    how = "meet it" if least_db is None else f"miss it by more than {least_db} dB"
    return f"called missed, with the tolerance of images that {how}"


def called_missed(excess_db: float) -> str:
    return f"called missed{near(excess_db)}"


ROWS = (
    *(within(db, kind) for kind in ("", ", exact images", ", factorized images") for db in (1, 3)),
    *(bound + where for bound in (UPPER, LOWER) for where in ("", *map(near, NEAR_DB))),
    UNDECIDED,
    *map(of_own, (None, *MISSED_DB)),
    *map(called_missed, EXCESS_DB),
)


def rows(
    scenes: int, jobs: int = 1, keep: Path | None = None, picture: Path | None = None
) -> list[list[str]]:
    """Return the rows of a table, the columns of which are `COLUMNS`.

    Parameters
    ----------
    scenes : int
        Number of scenes; their seeds begin at 0.
    jobs : int
        Number of processes.
    keep : Path, optional
        File that meets images, which are then not formed again.
    picture : Path, optional
        File for a picture.
    """
    images: list[Judged] = []
    for tried in tried_scenes(scenes, DRAWS, jobs, keep):
        where = f"seed {tried.seed}, {tried.family}"
        if tried.refusal:
            print(f"no number: {where}: {tried.refusal}; {tried.words}", flush=True)
        for each in tried.images:
            images.append(each)
            apart_db = max(each.by_sums_db, TRUSTED_DB) - max(each.true_db, TRUSTED_DB)
            if not tried.refusal and not abs(apart_db) <= AGREE_DB:
                print(
                    f"disagree: {where}: {each.kind} {each.asked_db:g}: {each.true_db:.1f} dB, by "
                    f"the certificate's sums {each.by_sums_db:.1f} dB; {tried.words}", flush=True
                )  # fmt: skip
    print(f"{len(images)} images, {DRAWS} draws of each")
    for kind in ("exact", "factorized"):
        excess_db = np.array([each.excess_db for each in images if each.kind == kind])
        missed = ", ".join(f"{np.sum(excess_db > db)} by more than {db} dB" for db in MISSED_DB)
        print(f"{len(excess_db)} {kind} images, misses before any is formed again: {missed}")
    print()
    shares = statistics(images, DRAWS)
    if picture:
        drawn(images, shares).savefig(picture, dpi=110)
        picture.write_bytes(with_fewer_colours(picture, 64))
    return [*shares.table(), *odds()]


class KnownMeasurement(Measurement):
    """A measurement of an image whose ideal pixels are known."""

    def __init__(self, image: clsas.Image, scene: Any, device: Device, seed: int) -> None:
        super().__init__(image, scene.lines, scene.beam, device, seed)
        self._known: NDArray[np.complex128] = scene.ideal

    def ideal(self, numbers: NDArray[np.int64]) -> NDArray[np.complex128]:
        """Return ideal pixels."""
        return self._known[numbers]


@dataclass(frozen=True)
class Judged:
    """An image: what was asked, and its error by the oracle and by the certificate's sums, dB.

    `long` and `short` hold error, variance and third moment of certificates relative to the true
    error, [draws, rounds, 3].
    """

    seed: int
    kind: str
    asked_db: float
    true_db: float
    by_sums_db: float
    pixels: int
    long: NDArray[np.float32]
    short: NDArray[np.float32]

    @property
    def excess_db(self) -> float:
        """By how much it misses its tolerance."""
        return self.true_db - self.asked_db


@dataclass(frozen=True)
class Tried:
    """A scene, its images, and the error of the certificate's sums, dB, or why there are none."""

    seed: int
    family: str
    words: str
    images: list[Judged]
    sums_db: float
    refusal: str


def tried_scenes(scenes: int, draws: int, jobs: int, keep: Path | None) -> Iterator[Tried]:
    """Yield all scenes, those in the file `keep` first, which takes the others too."""
    wanted = set(range(scenes))
    if keep and keep.exists():
        with open(keep, "rb") as file:
            while file.peek(1):
                tried = pickle.load(file)
                if tried.seed in wanted:
                    wanted.remove(tried.seed)
                    yield tried
    if not wanted:
        return
    if TESTS not in sys.path:
        sys.path.insert(0, TESTS)
    if jobs > 1:  # one core for each process
        os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", "1")
    with multiprocessing.get_context("spawn").Pool(jobs) as pool:
        for tried in pool.imap_unordered(partial(attempt, draws=draws), sorted(wanted)):
            if keep:
                with open(keep, "ab") as file:
                    pickle.dump(tried, file)
            yield tried


def attempt(seed: int, draws: int) -> Tried:
    """Return the images of a random scene, with many draws of certificates."""
    warnings.simplefilter("ignore", clsas.ClsasWarning)
    families = import_module("families")
    family = list(families.FAMILIES)[seed % len(families.FAMILIES)]
    is_bent = families.FAMILIES[family].water != ("one speed",)
    scene, device = families.draw(family, seed, PIXELS[is_bent]), open_device()
    if scene.is_dark:
        return Tried(seed, family, scene.words, [], np.nan, "all known pixels are dark")
    images = list(formed(scene, np.random.default_rng(seed), device))
    refusal, sums = "", np.full(scene.ideal.shape, np.nan + 0j)
    try:
        measurement = Measurement(images[0][2], scene.lines, scene.beam, device, seed)
        sums = measurement.ideal(np.arange(len(scene.pixels)))
    except ValueError as error:
        refusal = str(error)
    found = [judged(seed, *each, scene, sums, device, draws) for each in images]
    return Tried(seed, family, scene.words, found, oracle.error_db(sums, scene.ideal), refusal)


def formed(
    scene: Any, random: np.random.Generator, device: Device
) -> Iterator[tuple[str, float, clsas.Image]]:
    """Yield images of the known pixels of a scene: two exact ones, and up to two factorized."""
    slow = import_module("judging").SLOW
    lines, grid, beam = scene.lines, scene.grid, scene.beam
    known = clsas.Grid.points(grid.at(scene.pixels))

    def part(image: clsas.Image) -> clsas.Image:
        return clsas.Image(image.pixels.ravel()[scene.pixels], known)

    for asked_db in (-85.0, float(random.choice(ACCURACIES_DB))):
        image = clsas.backproject(
            lines, grid, accuracy_db=asked_db, beam=beam, device=device, certificate=False
        )
        yield "exact", asked_db, part(image)
    for asked_db in map(float, random.choice(TOLERANCES_DB, 2, replace=False)):
        plan = clsas.plan(lines, grid, tolerance_db=asked_db, beam=beam, device=device, costs=slow)
        if not plan.is_exact:
            image = clsas.factorize(lines, grid, plan, device=device, certificate=False)
            yield "factorized", asked_db, part(image)


def judged(
    seed: int,
    kind: str,
    asked_db: float,
    image: clsas.Image,
    scene: Any,
    sums: NDArray[np.complex128],
    device: Device,
    draws: int,
) -> Judged:
    """Return the true error of an image, and what certificates say of it."""
    true_db = oracle.error_db(image.pixels, scene.ideal)

    def moments(rounds: tuple[int, ...], first_seed: int) -> NDArray[np.float32]:
        found = np.zeros((draws, len(rounds), 3))
        for number in range(draws):
            measurement = KnownMeasurement(image, scene, device, first_seed + number)
            for level, more in enumerate(np.diff(rounds, prepend=0)):
                if not measurement.is_complete:
                    measurement.draw(int(more))
                each = measurement.certificate()
                found[number, level] = each.error, each.error_variance, each.error_third
        relative = found / 10 ** (true_db / 10 * np.arange(1, 4))
        return relative.astype(np.float32)

    return Judged(
        seed, kind, asked_db, true_db, oracle.error_db(image.pixels, sums), image.pixels.size,
        moments(LONG, 0), moments(SHORT, draws),
    )  # fmt: skip


def certificates(image: Judged, rounds: tuple[int, ...], draws: int) -> Iterator[list[Certificate]]:
    """Yield the certificates of every draw, one for each round; the true error is 0 dB."""
    moments = image.long if rounds is LONG else image.short
    for draw in moments[:draws].astype(float):
        yield [
            Certificate(min(count, image.pixels), image.pixels, 0.0, 1.0, *draw[level])
            for level, count in enumerate(rounds)
        ]


def after_rule(found: list[Certificate], affordable: float, tolerance_db: float) -> Certificate:
    """Return the certificate after which no more pixels are drawn."""
    for each in found[:-1]:
        more = more_pixels(each, tolerance_db, lambda share: affordable)
        if not more or each.pixels == each.of_pixels:
            return each
    return found[-1]


class Shares:
    """Shares of certificates of which something is true, by row and column."""

    def __init__(self) -> None:
        self._counts = {row: {column: [0, 0] for column in COLUMNS[1:]} for row in ROWS}

    def add(self, row: str, column: str, is_true: bool) -> None:
        """Count a certificate."""
        counts = self._counts[row][column]
        counts[0] += bool(is_true)
        counts[1] += 1

    def of(self, row: str, column: str) -> float:
        """Return a share, NaN if there is none."""
        true, count = self._counts[row][column]
        return true / count if count else np.nan

    def table(self) -> list[list[str]]:
        """Return the rows, in per cent."""
        found = []
        for row in ROWS:
            shares = [self.of(row, column) for column in COLUMNS[1:]]
            found.append([row, *("" if np.isnan(each) else f"{100 * each:.2f}" for each in shares)])
        return found


def statistics(images: list[Judged], draws: int) -> Shares:
    """Return what certificates say of images, and how often it is true."""
    shares = Shares()
    for image in images:
        for found in certificates(image, LONG, draws):
            for count, each in zip(LONG, found, strict=True):
                if count in FIXED and count < image.pixels:
                    column = f"{count} pixels"
                    scattered(shares, column, image, each)
                    judge(shares, column, image, partial(after_rule, [each], 0.0))
            judge(shares, "256 to 1024", image, partial(after_rule, found, np.inf))
        for found in certificates(image, SHORT, draws):
            judge(shares, "64 to 1024", image, partial(after_rule, found, 0.0))
    return shares


def scattered(shares: Shares, column: str, image: Judged, each: Certificate) -> None:
    """Count how far an estimate is from the true error."""
    for kind in ("", f", {image.kind} images"):
        for least_db in (1, 3):
            is_within = abs(each.error_db) <= least_db
            shares.add(within(least_db, kind), column, is_within)


def judge(
    shares: Shares, column: str, image: Judged, certificate_for: Callable[[float], Certificate]
) -> None:
    """Count what a draw says of an image with its own tolerance, and with others."""
    own = certificate_for(-image.excess_db)
    verdict = own.verdict(-image.excess_db)
    bounded(shares, "", column, own)
    kept_or_missed: list[int | None] = [each for each in MISSED_DB if image.excess_db > each]
    for least_db in kept_or_missed or [None]:
        shares.add(of_own(least_db), column, verdict == "missed")
    shares.add(UNDECIDED, column, verdict == "undecided")
    for excess_db in EXCESS_DB:
        each = certificate_for(-excess_db)
        shares.add(called_missed(excess_db), column, each.verdict(-excess_db) == "missed")
        if excess_db in NEAR_DB and " to " in column:
            bounded(shares, near(excess_db), column, each)


def bounded(shares: Shares, where: str, column: str, each: Certificate) -> None:
    """Count whether the bounds of an error hold."""
    shares.add(UPPER + where, column, each.upper_db >= 0)
    shares.add(LOWER + where, column, each.lower_db <= 0)


def odds() -> list[list[str]]:
    """Return rows of the odds that a single wrong pixel of a large image is drawn.

    It adds to the power and amplitude by which pixels are drawn; the others have equal power.
    """
    found = []
    for wrong_db in WRONG_DB:
        amplitude, others = 10 ** (wrong_db / 20), OF_PIXELS - 1
        by_power = amplitude**2 / (others + amplitude**2)
        share = (1 / OF_PIXELS + 2 * amplitude / (others + amplitude) + by_power) / 4
        cells = [f"{float(f'{100 * min(count * share, 1):.2g}'):g}" for count in FIXED]
        found.append([f"one wrong pixel of 10⁶ is drawn, {wrong_db:+g} dB", *cells, "", ""])
    return found


def drawn(images: list[Judged], shares: Shares) -> Figure:
    """Draw estimates and bounds over true errors, and shares called missed over the excess."""
    figure = Figure(figsize=(10, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    for kind, colour in (("exact", "tab:orange"), ("factorized", "tab:blue")):
        some = [each for each in images if each.kind == kind]
        first = [next(certificates(each, LONG, 1))[LONG.index(256)] for each in some]
        middle_db = np.array([each.error_db for each in first])
        low_db = np.array([max(each.lower_db, -20.0) for each in first])
        high_db = np.array([each.upper_db for each in first])
        left.errorbar(
            [each.true_db for each in some], middle_db, [middle_db - low_db, high_db - middle_db],
            fmt=".", color=colour, markersize=3, elinewidth=0.4, label=f"{len(some)} {kind} images",
        )  # fmt: skip
    left.axhline(0, color="black", linewidth=0.8)
    left.set(
        xlabel="true error (dB)", ylabel="estimate minus true error (dB)", ylim=(-5, 5),
        title="Estimates and bounds at 256 pixels",
    )  # fmt: skip
    left.legend(loc="upper right")
    for column, style, label in (
        ("64 pixels", ":", "64 pixels"),
        ("256 pixels", "--", "256 pixels"),
        ("64 to 1024", "-.", "64 to 1024, fast images"),
        ("256 to 1024", "-", "256 to 1024, slow images"),
    ):
        called = [100 * shares.of(called_missed(each), column) for each in EXCESS_DB]
        right.plot(EXCESS_DB, called, style, label=label)
    right.set(
        xlabel="true error relative to the tolerance (dB)", ylabel="called missed (%)",
        title="Misses that are found",
    )  # fmt: skip
    right.grid(alpha=0.3)
    right.legend(loc="center left", fontsize="small")
    return figure
