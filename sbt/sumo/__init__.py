"""Execution of concrete scenarios in SUMO; the only package that imports libsumo and traci."""
