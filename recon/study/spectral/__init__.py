"""The plaque in energy bins: basis materials, monochromatic images, tissue maps, by FBP and joint MBIR.

Read ``settings`` → ``measure`` (the order of the parts, noise and CNR of monochromatic images, joint MBIR) → ``scan``
(the scan, decomposed ray by ray, and its checks) → ``tissues`` (tissue maps and what they find) → ``calibration``
(scans decomposed with a wrong model; ``calibration_text`` says what it costs) → ``report`` → ``figures``.
"""
