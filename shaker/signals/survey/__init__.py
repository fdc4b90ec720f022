"""Which lines a record holds: peaks over the noise floor, fitted, taken out and named."""

from shaker.signals.survey.origins import Kind, LineList, Origin, name_lines
from shaker.signals.survey.survey import (
    Survey,
    decibel,
    expected_places,
    look,
    relative_strength,
    survey_lines,
    with_origins,
)

__all__ = [
    "Kind",
    "LineList",
    "Origin",
    "Survey",
    "decibel",
    "expected_places",
    "look",
    "name_lines",
    "relative_strength",
    "survey_lines",
    "with_origins",
]
