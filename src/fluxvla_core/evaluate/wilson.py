"""How sure a success rate is: the Wilson score interval.

E. B. Wilson, "Probable inference, the law of succession, and statistical inference", JASA 22
(1927), 209-212. Unlike the textbook interval it stays within 0 and 1 and holds its level for small
counts and for rates near 0 and 1 (Brown, Cai and DasGupta, Statistical Science 16 (2001), 101-133).
"""

from __future__ import annotations

from math import sqrt
from statistics import NormalDist


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Lower and upper end of the interval for a success rate.

    With rate ``p``, trials ``n`` and normal quantile ``z`` of ``(1 + confidence) / 2``::

        (p + z^2/2n ± z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n)

    No trials say nothing: (0, 1).

    Raises:
        ValueError: counts below 0, more successes than trials, or a confidence outside (0, 1).
    """
    if not 0 <= successes <= trials:
        raise ValueError(f"{successes} successes of {trials} trials are no counts")
    if not 0 < confidence < 1:
        raise ValueError(f"confidence must be between 0 and 1, got {confidence}")
    if trials == 0:
        return 0.0, 1.0
    z = NormalDist().inv_cdf((1 + confidence) / 2)
    rate, spread = successes / trials, z * z / trials
    middle = rate + spread / 2
    half = z * sqrt(rate * (1 - rate) / trials + spread / trials / 4)
    low, high = (middle - half) / (1 + spread), (middle + half) / (1 + spread)
    # Rounding must not leave a rate of exactly 0 or 1 outside its own interval.
    return max(0.0, min(low, rate)), min(1.0, max(high, rate))
