"""Contact of the surface with obstacles and with itself, in the ``total`` formulation."""
