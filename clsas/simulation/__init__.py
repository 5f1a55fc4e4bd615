"""Simulation: scenes, and the echoes or range lines that a sonar receives from them."""
