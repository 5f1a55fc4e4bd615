"""Simulation of scenes, and of the echoes or range lines that a sonar receives from them."""
