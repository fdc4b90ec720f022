"""Which lines a record holds: peaks over the noise floor, fitted, taken out and named."""

from shaker.signals.survey.origins import Kind, LineList, Origin, name_lines
from shaker.signals.survey.peaks import excess_power
from shaker.signals.survey.survey import (
    FALSE_ALARM,
    Survey,
    decibel,
    expected_places,
    look,
    no_lines,
    relative_strength,
    survey_lines,
    with_origins,
)

__all__ = [
    "FALSE_ALARM",
    "Kind",
    "LineList",
    "Origin",
    "Survey",
    "decibel",
    "excess_power",
    "expected_places",
    "look",
    "name_lines",
    "no_lines",
    "relative_strength",
    "survey_lines",
    "with_origins",
]
