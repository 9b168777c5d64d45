"""Needles on the cost map of a CT [Fu2018]."""
