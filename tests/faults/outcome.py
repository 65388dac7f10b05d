"""What came of a fault."""

from dataclasses import dataclass, field

__all__ = ["Outcome"]


@dataclass
class Outcome:
    """What came of a fault, or of many inputs of one kind."""

    what: str
    broken: list[str] = field(default_factory=list)
    """What was lost, differs, was left over, or is no sentence."""
    cases: int = 1
    reached: bool = True
    """Whether the fault came before the command had ended."""
    note: str = ""
    """For the report."""
