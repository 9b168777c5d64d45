"""Breathing: in which phases a plan is clear and on target, proved for every phase between."""
