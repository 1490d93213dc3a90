"""A mast for other people's tests: the pytest plug-in, and what its fixtures hand out.

Nothing here is imported by the service; the part that pytest loads at its start imports pytest and the
standard library only.
"""

from mastctl.testing.rover import RoverError, SetFault, SimulatedRover

__all__ = ["RoverError", "SetFault", "SimulatedRover"]
