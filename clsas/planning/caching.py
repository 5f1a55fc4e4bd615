"""Caches of what is computed from a visibility model, kept with the model."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clsas.planning.visibility_model import VisibilityModel


def cached(function: Callable[..., Any]) -> Callable[..., Any]:
    """Cache a function or method of a model by the model's limits and root and by its arguments.

    Models derived from each other share their cache.
    """

    @functools.wraps(function)
    def from_cache(model: VisibilityModel, *arguments: Hashable, **options: Hashable) -> Any:
        key = (function, model.limits, model.root, arguments, *options.items())
        return model.from_cache(key, lambda: function(model, *arguments, **options))

    return from_cache


def shared(function: Callable[[VisibilityModel], Any]) -> Callable[[VisibilityModel], Any]:
    """Cache a property that does not depend on limits and root."""

    @functools.wraps(function)
    def from_cache(model: VisibilityModel) -> Any:
        return model.from_cache(function, lambda: function(model))

    return from_cache
