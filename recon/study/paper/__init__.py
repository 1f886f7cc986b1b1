"""What the paper says (``facts``); how its plaque is scanned (``plaque_scan``, ``rods``) and read (``measures``)."""
