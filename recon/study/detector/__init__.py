"""The silicon detector: counts, efficiency beside the published one, pile-up and charge sharing.

Read ``settings`` → ``measure`` (the order of the parts) → ``rate`` (beam, counts, pile-up, charge sharing) →
``efficiency`` (photons followed through silicon and foils) → ``report`` → ``figures``.
"""
