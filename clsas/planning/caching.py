"""Caches of what is computed from a visibility model, kept with the model."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable
from typing import Concatenate, ParamSpec, Protocol, TypeVar

_Value = TypeVar("_Value")


class Caching(Protocol):
    """A model with a cache, as `VisibilityModel`."""

    @property
    def limits(self) -> tuple[float, float] | None:
        """Limits of the beam, on which cached values may depend."""

    @property
    def root(self) -> tuple[int, int] | None:
        """Size of the roots, on which cached values may depend."""

    def from_cache(self, key: Hashable, find: Callable[[], _Value]) -> _Value:
        """Return the value cached under a key; `find` computes it the first time."""


_Arguments = ParamSpec("_Arguments")
_Model = TypeVar("_Model", bound=Caching)


def cached(
    function: Callable[Concatenate[_Model, _Arguments], _Value],
) -> Callable[Concatenate[_Model, _Arguments], _Value]:
    """Cache a function or method of a model by the model's limits and root and by its arguments.

    The arguments must be hashable. Models derived from each other share their cache.
    """

    @functools.wraps(function)
    def from_cache(
        model: _Model, *arguments: _Arguments.args, **options: _Arguments.kwargs
    ) -> _Value:
        key = (function, model.limits, model.root, arguments, *options.items())
        return model.from_cache(key, lambda: function(model, *arguments, **options))

    return from_cache


def shared(function: Callable[[_Model], _Value]) -> Callable[[_Model], _Value]:
    """Cache a property that does not depend on limits and root."""

    @functools.wraps(function)
    def from_cache(model: _Model) -> _Value:
        return model.from_cache(function, lambda: function(model))

    return from_cache
