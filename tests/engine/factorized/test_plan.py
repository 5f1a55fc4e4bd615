import dataclasses
import json
import re
from functools import partial

import numpy as np
import pytest
from factorizing import (
    BEAMS,
    EXACT_IS_SLOW,
    around,
    changed,
    made,
    moving_array,
    over,
    peak_device_bytes,
    planned,
    straight,
    swaying,
)

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.digests import grid_digest, lines_digest, with_digest
from clsas.engine.data.grid import Grid
from clsas.engine.data.sound_speed import SoundSpeed
from clsas.engine.device.device import open_device
from clsas.engine.factorized import measured_costs as costs
from clsas.engine.factorized.plan import VERSION, Plan
from clsas.engine.imaging import factorize, plan


@pytest.fixture(scope="module")
def chosen():
    return planned(swaying, -50)


@pytest.fixture(scope="module")
def given_stages():
    return plan(*made(straight), stages=[(4, 2), (4, 2)])


@pytest.fixture(scope="module")
def exact():
    return plan(*made(straight), stages=[])


@pytest.fixture(params=["chosen", "given_stages", "exact"])
def any_plan(request):
    return request.getfixturevalue(request.param)


# JSON


def changeable(plan):
    """A plan's JSON as a dict that may be changed and signed again."""
    values = json.loads(plan.to_json())
    del values["digest"]
    return values


def signed(values):
    """The JSON of a changed dict, with a new digest."""
    return json.dumps(with_digest(values))


def replaced(plan, path, value):
    """A plan's JSON with another value at a path such as "method.sides"."""
    values = changeable(plan)
    *tables, name = path.split(".")
    table = values
    for each in tables:
        table = table[each]
    table[name] = value
    return signed(values)


def test_text_gives_the_same_plan(any_plan):
    again = Plan.from_json(any_plan.to_json())
    assert again.to_json() == any_plan.to_json()
    for one, other in ((again, any_plan), (again.method, any_plan.method)):
        for field in dataclasses.fields(other):
            value = getattr(other, field.name)
            if not dataclasses.is_dataclass(value):
                assert getattr(one, field.name) == value, field.name
    for field in dataclasses.fields(any_plan.prediction):
        name = field.name
        assert getattr(again.prediction, name) == getattr(any_plan.prediction, name), name


@pytest.mark.parametrize("along", [None, [1.0, 0.1, 0], "every channel"])
def test_json_contains_the_beam(along):
    lines, grid = made(straight)
    if along == "every channel":
        along = np.tile([1.0, 0.02, 0], (lines.channels, 1))
    beam = dataclasses.replace(BEAMS[2], along=along)
    chosen = plan(lines, grid, tolerance_db=-40, beam=beam, costs=EXACT_IS_SLOW)
    again = Plan.from_json(chosen.to_json()).beam
    q = np.linspace(-1, 1, 1000)
    np.testing.assert_array_equal(again.weights(q), beam.weights(q))
    np.testing.assert_allclose(again.directions(lines), beam.directions(lines), atol=1e-15)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "{}", "null", "5", "NaN", "\x00", '"plan"', "[[]]", None, 5]
)
def test_text_that_is_no_plan_is_refused(text):
    with pytest.raises((ValueError, TypeError), match=r"text must be a plan as of Plan\.to_json"):
        Plan.from_json(text)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("method", None),
        ("method", {}),
        ("method.kind", "exact"),
        ("method.kind", "guess"),
        ("method.sides", "ab"),
        ("method.sides", []),
        ("method.sides", [[0, 0]]),
        ("method.sides", [[64, 64], [48, 16]]),
        ("method.sides", None),
        ("method.tile", [3, 3]),
        ("method.tile", [16]),
        ("method.align", "filter"),
        ("method.align", None),
        ("method.aperture", None),
        ("method.aperture.filter", None),
        ("method.aperture.filter.taps", 1),
        ("method.aperture.filter.taps", 10),
        ("method.align.upsampling", 0.5),
        ("method.final", None),
        ("method.resampling", None),
        ("method.resampling", {}),
        ("method.resampling.length", 0),
        ("method.resampling.period", 2**31),
        ("method.resampling.shift", 2**40),
        ("method.resampling.first", -(2**21)),
        ("method.resampling.lead", -1),
        ("method.resampling.upsampled_period", 7),
        ("method.upsampler", 3),
        ("method.upsampler", {}),
        ("method.upsampler", {"step": 0, "coefficients": [[0.0] * 16] * 32, "error_db": -60.0}),
        ("method.upsampler", {"step": 20, "coefficients": [[0.0] * 16] * 31, "error_db": -60.0}),
        (
            "method.upsampler",
            {"step": 20, "coefficients": [[float("nan")] * 16] * 32, "error_db": 0.0},
        ),
        ("method.half_precision", 1),
        ("method.half_precision", None),
        ("method.limits", [0.1, 0.2]),
        ("method.aperture.oversampling", [1e9, 1e9, 1e9]),
        ("method.aperture.oversampling", [1.0]),
        ("method.aperture.oversampling", [float("nan")] * 3),
        ("method.aperture.beam_cycles", 1e9),
        ("method.aperture.band", None),
        ("method.aperture.band", [0.0, 3.0]),
        ("method.aperture", {"method": "nearest", "factors": ["x"]}),
        ("method.aperture", {"method": "nearest", "factors": [0, 0]}),
        ("method.aperture", {"method": "nearest", "factors": [2]}),
        ("method.tile", [16, 4]),
        ("method.half_lengths", []),
        ("method.half_lengths", "ab"),
        ("method.half_lengths", [-5, -5, -5]),
        ("method.most_channels", [1]),
        ("method.highest_cycles_per_m", "many"),
        ("method.closest_m", float("inf")),
        ("method.roots_at_once", 0),
        ("method.roots_at_once", True),
        ("method.roots_prepared", 2**40),
        ("prediction.stages", [1]),
        ("prediction.memory_bytes", -1),
        ("prediction.error_db", "low"),
        ("prediction.error_db", float("nan")),
        ("prediction.work.leaf", -1.0),
        ("prediction.errors", {"bad luck": 1.0}),
        ("beam", 7),
        ("beam", {"width_deg": -1.0}),
        ("beam", {"colour": "red"}),
        ("tolerance_db", "low"),
        ("tolerance_db", []),
        ("left_out", ["gravity"]),
    ],
)
def test_a_plan_with_a_wrong_value_is_refused(chosen, field, value):
    """Otherwise a kernel might read outside its buffers. The message names the field."""
    with pytest.raises(ValueError, match=r"^text must be a plan as of Plan\.to_json: ") as refused:
        Plan.from_json(replaced(chosen, field, value))
    named = re.findall(r"\w+", str(refused.value))
    assert any(part in named for part in field.split(".")), refused.value
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        (
            "method.roots_at_once",
            0,
            "method.roots_at_once must be at least 1, got 0",
        ),
        ("method.half_precision", 1, "method.half_precision must be of type bool, got int"),
        ("method.colour", 1, "method.colour is unknown"),
        ("method", {}, "method.kind must be one of 'factorized', 'exact', got None"),
        ("method", {"kind": "x"}, "method.kind must be one of 'factorized', 'exact', got 'x'"),
        ("tolerance_db", float("nan"), "tolerance_db must be finite dB, got nan"),
        (
            "method.half_lengths",
            [1],
            r"method.half_lengths must be \d numbers, one for each stage, got \(1,\)",
        ),
    ],
)
def test_the_message_names_the_mistake(chosen, field, value, message):
    with pytest.raises(ValueError, match=message):
        Plan.from_json(replaced(chosen, field, value))


@pytest.mark.parametrize("version", [VERSION - 1, VERSION + 1, "2", None])
def test_a_plan_of_another_version_is_refused(chosen, version):
    values = changeable(chosen) | {"version": version}
    with pytest.raises(ValueError, match=r"written by .*: make the plan again with `clsas\.plan`"):
        Plan.from_json(json.dumps(values))


def places_of_numbers(value, path=()):
    """The paths of all numbers in values of JSON, with one number of every list in a list."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from places_of_numbers(part, (*path, name))
    elif isinstance(value, list):
        for number, part in enumerate(value[:1] if "coefficients" in path else value):
            yield from places_of_numbers(part, (*path, number))
    elif isinstance(value, (int, float)):
        yield path


@pytest.mark.slow
def test_no_number_of_a_plan_can_be_replaced_unless_an_image_can_be_formed(any_plan):
    """Numbers size buffers and indices: a kernel must not read or write beyond its buffers."""
    lines, grid = made(swaying if any_plan.tolerance_db else straight)
    text = any_plan.to_json()
    for path in places_of_numbers(changeable(any_plan)):
        for value in (1e30, -1, float("nan"), "x", [], None, True):
            values = json.loads(text)
            del values["digest"]
            table = values
            for part in path[:-1]:
                table = table[part]
            table[path[-1]] = value
            read, refused = None, ""
            try:
                read = Plan.from_json(signed(values))
            except ValueError as error:
                refused = str(error)
            if read is None:
                *_, name = (part for part in path if isinstance(part, str))
                assert name in re.findall(r"\w+", refused), (path, refused)
            else:
                assert read.describe()
                if path[0] != "prediction":
                    factorize(lines, grid, read)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("method.sides", [[64, 64]] * 65, "method.sides must be of 1 to 64 stages, got 65"),
        ("method.half_lengths", [8] * 10**5, "method.half_lengths must be 3 numbers"),
        ("method.aperture.oversampling", [1.0] * 10**5, "aperture.oversampling must be 3 numbers"),
        ("method.tile", [16] * 10**5, "method.tile must be 2 numbers"),
        ("left_out", ["relief of the grid"] * 4, "left_out must be some of"),
        ("prediction.stages", [], "prediction.stages must not be empty"),
    ],
)
def test_a_list_of_another_length_is_refused(chosen, field, value, message):
    with pytest.raises(ValueError, match=message):
        Plan.from_json(replaced(chosen, field, value))


def test_the_prediction_of_many_stages_is_refused(chosen):
    values = changeable(chosen)
    values["prediction"]["stages"] *= 1000
    with pytest.raises(ValueError, match=r"prediction\.stages must be at most 65, got"):
        Plan.from_json(signed(values))


@pytest.mark.parametrize("coefficients", ["none", [[1.0]], [[[None]]], []])
@pytest.mark.parametrize("name", ["align", "aperture.filter", "final"])
def test_a_filter_that_is_none_is_refused(chosen, name, coefficients):
    with pytest.raises(ValueError, match="coefficients"):
        Plan.from_json(replaced(chosen, f"method.{name}.coefficients", coefficients))


def test_a_plan_with_a_field_too_many_or_too_few_is_refused(chosen):
    values = changeable(chosen)
    with pytest.raises(ValueError, match=r"Plan\.to_json: colour is unknown"):
        Plan.from_json(signed(values | {"colour": 1}))
    for tables, name in (([], "left_out"), (["method"], "sides"), (["prediction", "work"], "leaf")):
        less = changeable(chosen)
        table = less
        for each in tables:
            table = table[each]
        del table[name]
        with pytest.raises(ValueError, match=f"{'.'.join(tables) or 'it'} lacks '{name}'"):
            Plan.from_json(signed(less))


# Properties and descriptions


def test_it_is_immutable(any_plan):
    with pytest.raises(dataclasses.FrozenInstanceError):
        any_plan.tolerance_db = -20.0
    for each in (any_plan, Plan.from_json(any_plan.to_json())):
        for part in (each, each.method, each.prediction):
            with pytest.raises(dataclasses.FrozenInstanceError):
                part.kind = "guess"
        assert isinstance(each.sides, tuple)
        assert isinstance(each.stages, tuple)
        if not each.is_exact:
            for name in ("tile", "half_lengths", "most_channels"):
                assert isinstance(getattr(each.method, name), tuple), name


def test_a_changed_number_is_found(chosen):
    text = chosen.to_json()
    Plan.from_json(json.dumps(json.loads(text), indent=None, sort_keys=True))  # the same values
    start = text.index('"coefficients"')
    position = start + re.search(r"\.0*[1-8]", text[start:]).end() - 1  # a leading digit
    changed = text[:position] + str(int(text[position]) + 1) + text[position + 1 :]
    with pytest.raises(ValueError, match="its digest differs"):
        Plan.from_json(changed)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, "[]", "5", "", "{", '{"a": 1}'])
def test_other_text_is_no_plan(text):
    with pytest.raises(ValueError, match=r"text must be a plan as of Plan\.to_json"):
        Plan.from_json(text)


def test_its_filters_are_read_only(chosen):
    for each in (chosen, Plan.from_json(chosen.to_json())):
        image = each.factorization
        for filter_ in (image.align, image.aperture.filter, image.final):
            with pytest.raises(ValueError, match="read-only"):
                filter_.coefficients[...] = 0


def test_only_a_plan_that_divides_has_a_factorization(exact):
    with pytest.raises(TypeError, match="must divide the image"):
        _ = exact.factorization


def test_its_stages_divide_those_before(chosen, given_stages):
    for each in (chosen, given_stages):
        for (rows, columns), (fewer_rows, fewer_columns) in zip(
            each.sides[:-1], each.sides[1:], strict=True
        ):
            assert rows % fewer_rows == columns % fewer_columns == 0
            assert (rows, columns) != (fewer_rows, fewer_columns)
        assert np.all(np.array(each.sides[-1]) % each.factorization.tile == 0)


def test_it_describes_itself(chosen):
    text = chosen.describe()
    assert "tolerance -50 dB" in text
    assert f"predicted error {chosen.predicted_error_db:.1f} dB" in text
    lines = text.splitlines()
    assert max(map(len, lines[1:])) <= 100
    table = [line for line in lines[2:] if line.split()[0] != "stage"]
    table = table[: next(i for i, line in enumerate(table) if line.startswith("Error by cause"))]
    assert len(table) == len(chosen.sides) + 1
    for (rows, columns), line in zip(chosen.sides, table, strict=False):
        assert f"{rows} x {columns}" in line
    assert len({len(line) for line in table}) == 1  # columns that line up


@pytest.mark.parametrize(("asked", "shown"), [(-12.338089, "-12.34 dB"), (-50.5, "-50.5 dB")])
def test_a_tolerance_is_shown_with_few_digits(chosen, asked, shown):
    text = dataclasses.replace(chosen, tolerance_db=asked).describe()
    assert f"tolerance {shown};" in text


def test_given_stages_describe_themselves(given_stages):
    text = given_stages.describe()
    assert "stages as given" in text
    assert "sums of 4, 4 neighbours" in text


def test_plain_backprojection_says_so(exact):
    assert "Plain backprojection" in exact.describe()
    # Without a tolerance there is no reason to report.
    assert "nearest beam" not in exact.describe()


@pytest.mark.slow
@pytest.mark.parametrize("beam", [None, BeamWindow(8, "hann", normalise=True)], ids=str)
@pytest.mark.parametrize("case", [straight, moving_array, "points", "one pixel", "few channels"])
def test_device_memory_of_plain_backprojection(monkeypatch, case, beam):
    if case == "points":
        lines, grid = over(Grid.points(around(0, 40).positions_m()))
    elif callable(case):
        lines, grid = made(case)
    else:
        lines, grid = over(around(0, 40, shape=(1, 1) if case == "one pixel" else (150, 160)))
        lines = lines.select(slice(100, 220)) if case == "few channels" else lines
    planned = plan(lines, grid, stages=[], beam=beam)
    peak = peak_device_bytes(monkeypatch, partial(factorize, lines, grid, planned), None)
    assert 0.5 * planned.memory_bytes <= peak <= 1.01 * planned.memory_bytes


# Digests


def changed_lines():
    lines, _ = made(straight)
    yield "tx_m", lines.tx_m + [1e-9, 0, 0]
    yield "rx_m", lines.rx_m + [0, 0, 1e-9]
    yield "first_range_m", lines.first_range_m + 1e-9
    yield "range_step_m", lines.range_step_m * (1 + 1e-12)
    yield "carrier_hz", lines.carrier_hz + 1e-6
    yield "sound_speed_m_s", lines.sound_speed_m_s + 1e-6
    yield "rx_velocity_m_s", [1e-9, 0, 0]
    yield "samples", lines.samples[:, :-1]


def test_lines_of_another_geometry_are_other_lines():
    lines, _ = made(straight)
    for field, value in changed_lines():
        other = dataclasses.replace(lines, **{field: value})
        assert lines_digest(other) != lines_digest(lines), field


def test_lines_in_other_water_are_other_lines():
    lines, _ = made(straight)
    profiles = [
        None,
        SoundSpeed([0.0, 50.0], [1490.0, 1500.0]),
        SoundSpeed([0.0, 50.0], [1490.0, 1500.1]),
        SoundSpeed([0.0, 50.1], [1490.0, 1500.0]),
        SoundSpeed([0.0, 50.0], [1490.0, 1500.0], surface_z_m=0.1),
    ]
    digests = {lines_digest(dataclasses.replace(lines, sound_speed=each)) for each in profiles}
    assert len(digests) == len(profiles)


def test_louder_lines_are_the_same_lines():
    lines, _ = made(straight)
    louder = dataclasses.replace(lines, samples=2 * lines.samples)
    assert lines_digest(louder) == lines_digest(lines)
    looking = dataclasses.replace(lines, look_direction=[0, 1, 0])
    assert lines_digest(looking) == lines_digest(lines)


def test_other_grids_have_other_digests():
    grid = around(0, 40, shape=(4, 6))
    others = (
        around(1e-9, 40, shape=(4, 6)),
        around(0, 40, shape=(6, 4)),
        around(0, 40, shape=(4, 6), z=1e-9),
        around(0, 40, shape=(4, 6), pixel_m=(0.015, 0.0151)),
        grid.with_height(np.zeros((4, 6))),
        type(grid).points(grid.positions_m()),
    )
    assert len({grid_digest(each) for each in (grid, *others)}) == 7
    assert grid_digest(around(0, 40, shape=(4, 6))) == grid_digest(grid)


def test_a_plan_knows_its_lines_and_grid(chosen):
    lines, grid = made(swaying)
    chosen.check(lines, grid)
    other_lines, _ = over(around(0, 40))
    with pytest.raises(ValueError, match=r"^lines must have the geometry"):
        chosen.check(other_lines, grid)
    with pytest.raises(ValueError, match=r"^grid must have the geometry"):
        chosen.check(lines, around(0, 41))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("align", 3),
        ("half_lengths", (-1, 2, 3)),
        ("stretch", np.nan),
        ("most_channels", (2**40,) * 3),
        ("resampling", None),
        ("kind", "guess"),
    ],
)
def test_a_plan_cannot_get_a_field_that_is_not_allowed(chosen, field, value):
    with pytest.raises((TypeError, ValueError), match=f"^{field}"):
        changed(chosen, **{field: value})


def test_a_prediction_cannot_get_a_field_that_is_not_allowed(chosen):
    for field, value, named in (
        ("seconds", -1.0, "seconds"),
        ("stages", [1], r"stages\[0\]"),
        ("stages", chosen.stages * 100, "stages"),
        ("work", dataclasses.replace(chosen.work, leaf=np.ones(3)), "work.leaf"),
        ("errors", dataclasses.replace(chosen.errors, roots=np.inf), "errors.roots"),
        ("cost_source", "guessed", "cost_source"),
    ):
        with pytest.raises((TypeError, ValueError), match=f"^{named} must be"):
            dataclasses.replace(chosen.prediction, **{field: value})


def test_a_frequency_that_lines_cannot_hold_is_refused(chosen):
    """It would need unlimited memory."""
    lines, grid = made(swaying)
    with pytest.raises(ValueError, match=r"highest_cycles_per_m must be .* cycles/m, got 1e\+09"):
        factorize(lines, grid, changed(chosen, highest_cycles_per_m=1e9))


def test_it_says_whether_times_are_of_this_device(chosen, monkeypatch, tmp_path):
    lines, grid = made(straight)
    monkeypatch.setenv("CLSAS_CACHE", str(tmp_path))
    usual = plan(lines, grid, stages=[])
    assert usual.prediction.cost_source == "default"
    words = "Times follow from default costs, which were not scaled to this device; `clsas devices"
    assert words in usual.describe()
    device = open_device()
    costs.save(device, costs.defaults(device))
    scaled = plan(lines, grid, tolerance_db=-50)
    day = scaled.prediction.costs_measured[:10]
    words = (
        f"Times follow from default costs, scaled to this device by a short measurement on {day}"
    )
    assert words in scaled.describe()
    given = plan(lines, grid, tolerance_db=-50, costs=costs.Costs())
    assert "Times follow from costs that were given." in given.describe()
    assert Plan.from_json(scaled.to_json()).prediction.cost_source == "scaled"


def test_json_may_leave_out_filters(chosen):
    short, whole = chosen.to_json(filters=False), chosen.to_json()
    assert len(short) < 0.5 * len(whole)

    def without(values):
        if not isinstance(values, dict):
            return values
        return {key: without(part) for key, part in values.items() if key != "coefficients"}

    values = json.loads(whole)
    del values["digest"]  # it applies to complete plans only
    assert json.loads(short) == without(values)
    with pytest.raises(ValueError, match=r"lacks 'digest', like .* without filters"):
        Plan.from_json(short)
