"""CT numbers of 4 mm rods of each tissue at the plaque's place: ``truth`` of ``notebooks/dose_factor/report.json``."""

__all__ = ["ROD_HU"]

ROD_HU = {"fat": -92.65, "wall": 63.53, "fibrous": 103.22, "lumen": 479.97, "core": 41.07}
