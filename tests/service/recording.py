"""What a progress is told, kept to be judged."""

from typing import NamedTuple


class Stage(NamedTuple):
    """One stage of work."""

    name: str
    total: int
    told: list[int]
    """Each number of finished steps, in the order in which it was told."""

    @property
    def fault(self) -> str | None:
        """What is wrong with a stage that has ended, or None.

        A stage of one step may end without a word; every other one tells of its last step.
        """
        if self.total < 1:
            return f"{self.name}: has {self.total} steps"
        if self.told != sorted(self.told):
            return f"{self.name}: goes back: {self.told}"
        last = self.told[-1] if self.told else 0
        if last > self.total or (last < self.total and self.total > 1):
            return f"{self.name}: ends at {last} of {self.total}"
        return None


class Recording:
    """A service.reporting.progress.Progress that keeps everything it is told."""

    def __init__(self) -> None:
        self.stages: list[Stage] = []

    def stage(self, name: str, total: int) -> None:
        self.stages.append(Stage(name, total, []))

    def advance(self, done: int) -> None:
        self.stages[-1].told.append(done)

    @property
    def faults(self) -> list[str]:
        """What is wrong with the stages of a work that came to its end."""
        return [stage.fault for stage in self.stages if stage.fault is not None]
