"""Simulation of scenes, and of the echoes or range lines that a sonar receives from them."""

from clsas.simulation.sea_water import teos10_speed_m_s as teos10_speed_m_s
