"""Geometry, measurement, estimation and storage: arrays and frozen dataclasses in and out."""
