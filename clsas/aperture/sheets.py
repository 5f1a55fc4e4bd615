"""Positions on a sheet: a curve along the aperture that moves sideways, as a polynomial."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline


@dataclass(frozen=True, eq=False)
class Sheet:
    """A smooth sheet over an aperture coordinate and a coordinate across, each from 0 to 1.

    Positions are cubic splines along the aperture and polynomials across it. Past its edges the
    sheet is continued straight.

    Attributes
    ----------
    spline : BSpline
        Coefficients of the powers of the coordinate across, [powers, 3], over the aperture
        coordinate; metres.
    """

    spline: BSpline

    def positions_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions, [..., 3]."""
        inside = np.clip(coordinate, 0, 1)
        position_m = _polynomial(self.spline(inside), across)
        beyond = inside != coordinate
        past = (coordinate - inside)[beyond]
        if past.size:
            tangent_m = _polynomial(self.spline(inside[beyond], 1), across[beyond])
            position_m[beyond] += past[:, None] * tangent_m
        return position_m

    def tangents_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the derivatives of positions by the aperture coordinate, [..., 3]."""
        return _polynomial(self.spline(np.clip(coordinate, 0, 1), 1), across)

    def sideways_m(
        self, coordinate: NDArray[np.float64], across: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the derivatives of positions by the coordinate across, [..., 3]."""
        coefficients = self.spline(np.clip(coordinate, 0, 1))
        powers = np.arange(1, coefficients.shape[-2])
        inside = np.clip(across, 0, 1)[..., None]
        return np.einsum(
            "...ki,...k->...i", coefficients[..., 1:, :], powers * inside ** (powers - 1)
        )

    def positions_on_grid_m(
        self, columns: NDArray[np.float64], rows: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions at all pairs of a row and a column, [n, rows, columns, 3].

        Parameters
        ----------
        columns : float64 [n, columns]
            Aperture coordinates.
        rows : float64 [n, rows]
            Coordinates across.
        """
        inside = np.clip(columns, 0, 1)
        coefficients = self.spline(inside)
        coefficients += (columns - inside)[..., None, None] * self.spline(inside, 1)
        shape = (*rows.shape, columns.shape[1])
        return _polynomial(coefficients[:, None], np.broadcast_to(rows[..., None], shape))

    def curve_along(self, across: float) -> BSpline:
        """Return positions over the aperture coordinate, at one coordinate across."""
        powers = across ** np.arange(self.spline.c.shape[1])
        coefficients = np.einsum("nki,k->ni", self.spline.c, powers)
        return BSpline(self.spline.t, coefficients, self.spline.k)

    def curve_across(self, coordinate: float) -> BSpline:
        """Return positions over the coordinate across, at one aperture coordinate."""
        powers = self.spline(coordinate)
        degree = len(powers) - 1
        # Bernstein coefficients of the polynomial are those of a spline without inner knots.
        bernstein = np.array(
            [
                [math.comb(i, k) / math.comb(degree, k) for k in range(degree + 1)]
                for i in range(degree + 1)
            ]
        )
        knots = np.repeat([0.0, 1.0], degree + 1)
        return BSpline(knots, bernstein @ powers, degree)


def _polynomial(coefficients: NDArray[np.float64], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return polynomials of coefficients [..., powers, 3], straight beyond 0 to 1, [..., 3]."""
    powers = coefficients.shape[-2]
    if powers == 2:
        return coefficients[..., 0, :] + at[..., None] * coefficients[..., 1, :]
    inside = np.clip(at, 0, 1)[..., None]
    value, slope = np.zeros((2, *at.shape, 3))
    for power in reversed(range(powers)):
        slope = slope * inside + value
        value = value * inside + coefficients[..., power, :]
    return value + (at[..., None] - inside) * slope
