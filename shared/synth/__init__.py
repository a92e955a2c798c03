"""A synthetic city scan: the scene that every fresh clone draws first, made without any data file.

``primitives``  materials, patches of surface, and placing copies of them
``buildings``   façades from repeated bays, roofs, houses, a church
``nature``      trees, hedges, the park
``terrain``     the lie of the land and the grid's measures
``city``        the plan: streets and blocks as one array of primitives
``sampling``    points on primitives by area
``light``       colours: sun, shadows, sky
``scan``        ``CityScan``: points in batches, with noise and attributes
``las``         ``write_las``: a file to open elsewhere
"""

from .las import write_las
from .scan import CityScan

__all__ = ["CityScan", "write_las"]
