"""Landmarks of rendered rooms against exact instance truth."""
