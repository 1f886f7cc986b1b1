"""What the paper says (``facts``, ``tables``); how its plaque is scanned (``plaque_scan``) and read (``measures``)."""
