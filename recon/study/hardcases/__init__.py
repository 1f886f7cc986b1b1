"""Hard cases: what every method makes of scans that are starved, broken, incomplete or wrongly described.

Read ``settings`` → ``cases`` (the registry: what is done to the scan) → ``measure`` (error, warning, verdict of every
case and method) → ``report`` → ``figures``.
"""
