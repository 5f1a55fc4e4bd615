"""What a model keeps belongs to its limits and its roots."""

from dataclasses import dataclass, field, replace

from clsas.planning.caching import cached, shared


@dataclass(frozen=True)
class Model:
    limits: tuple[float, float] | None = None
    root: tuple[int, int] | None = None
    kept: dict = field(default_factory=dict)
    calls: list = field(default_factory=list)

    def from_cache(self, key, find):
        if key not in self.kept:
            self.kept[key] = find()
        return self.kept[key]

    @cached
    def extent(self, side, *, most=False):
        self.calls.append((side, most))
        return self.limits, self.root, side, most

    @shared
    def name(self):
        self.calls.append("name")
        return "name"


def test_values_of_other_roots_limits_and_arguments_are_apart():
    model = Model()
    models = [model, replace(model, root=(8, 8)), replace(model, root=(8, 16)),
              replace(model, limits=(0.0, 1.0)), replace(model, limits=(0.0, 2.0))]  # fmt: skip
    for _ in range(2):
        for each in models:
            assert each.extent(4) == (each.limits, each.root, 4, False)
            assert each.extent(4, most=True) == (each.limits, each.root, 4, True)
            assert each.extent(5) == (each.limits, each.root, 5, False)
            assert each.name() == "name"
    assert len(model.calls) == 3 * len(models) + 1
