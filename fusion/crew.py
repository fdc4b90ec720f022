"""Those who compute tasks for a run: what a recording needs to know of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol


class Answer(Protocol):
    """What a task returned or raised, and what it logged."""

    def opened(self) -> Any:
        """Return or raise what the task did."""

    def log(self, name: str) -> None:
        """Log what the task logged, behind the name of what it was about."""


class Pending(Protocol):
    """The answer of a task that another process computes."""

    def result(self) -> Answer:
        """Return it, or raise why there is none."""

    def add_done_callback(self, told: Callable[[Any], object]) -> None:
        """Have a function called as soon as there is an answer or none will be."""


class Crew(Protocol):
    """Processes that compute tasks, one each at a time."""

    @property
    def size(self) -> int:
        """How many there are."""

    def submit(self, rank: int, function: Callable[..., Any], *arguments: Any) -> Any:
        """Have a module's function called; of the tasks that wait, the lowest rank comes first.

        Answers that are there may be arguments: the function receives what they hold.
        """
