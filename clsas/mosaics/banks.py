"""Receiver banks of a survey: the channels of one bank, and their samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from clsas.engine.data.beam import BeamWindow
from clsas.engine.data.lines import RangeLines, bank_members
from clsas.mosaics.survey import Survey
from clsas.mosaics.visibility import SurveyVisibility


@dataclass(frozen=True, eq=False)
class Bank:
    """One receiver bank of a survey.

    Attributes
    ----------
    survey : Survey
        The survey, which may have other banks too.
    members : int64 [channels]
        Channels of the survey that belong to the bank.
    visibility : SurveyVisibility
        The channels of the bank alone, without their samples.
    """

    survey: Survey
    members: NDArray[np.int64]
    visibility: SurveyVisibility

    @classmethod
    def of(cls, survey: Survey, number: int | None, beam: BeamWindow | None) -> Self:
        """Return a bank of a survey by its number; None stands for all channels."""
        geometry = survey.geometry
        chosen = np.arange(survey.channels)
        if number is not None:
            chosen = chosen[bank_members(geometry.bank_numbers, number)]
            geometry = geometry.bank(number)
        begins = np.searchsorted(chosen, survey.begins)
        alone = replace(survey, geometry=geometry, begins=tuple(map(int, begins)))
        return cls(survey, chosen, SurveyVisibility.of(alone, beam))

    @property
    def geometry(self) -> RangeLines:
        """Geometry of the bank's channels."""
        return self.visibility.survey.geometry

    def read(
        self, visible: NDArray[np.bool_], near_m: NDArray[np.float64], far_m: NDArray[np.float64]
    ) -> tuple[RangeLines, NDArray[np.bool_]]:
        """Return lines of the bank between two ranges; see `Survey.read`."""
        chosen = np.zeros(self.survey.channels, bool)
        chosen[self.members[visible]] = True
        ends_m = np.zeros((2, self.survey.channels))
        ends_m[:, self.members] = near_m, far_m
        lines, missing = self.survey.read(chosen, *ends_m)
        return replace(lines, bank_numbers=None), missing
