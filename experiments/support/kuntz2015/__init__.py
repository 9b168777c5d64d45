"""Measurements for the figures of [Kuntz2015]."""
