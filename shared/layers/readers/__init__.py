"""Readers of what layers are made from: outlines, tracks, tables, point clouds."""
