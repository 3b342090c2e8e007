"""Wind and the force it exerts on surface patches."""
