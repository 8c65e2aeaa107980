"""Where the seeds of situations lie, so that nobody is tutored on what it is tested on.

Trials have the seeds from `evaluator.seed` on, which the configuration keeps below all of these.
"""

from __future__ import annotations

from typing import Final

TRIALS_BELOW: Final = 2**29
CORRECTIONS: Final = range(2**29, 2**30)
"""Situations that the learner draws at random."""
PRACTICE: Final = range(2**30, 2**31)
"""Situations that actors draw themselves."""
