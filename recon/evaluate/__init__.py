"""What a reconstruction is judged against: :mod:`~recon.evaluate.rivals`, the strongest simple filters of a volume."""
