"""Ranges of the seeds of situations: no policy is tutored or corrected on what it is tested on.

Trials have the seeds from `evaluator.seed` on, all below TRIALS_BELOW. Tutored cases are no random
situations: their seeds decide only about the execution noise.
"""

from __future__ import annotations

from typing import Final

TRIALS_BELOW: Final = 2**29
CORRECTIONS: Final = range(2**29, 2**30)
"""Situations that the learner draws for corrections."""
PRACTICE: Final = range(2**30, 2**31)
"""Situations that actors draw for practice."""
SEEDS_PER_CASE: Final = 1000
"""Seeds of a tutored case, one for each repeat of it."""
