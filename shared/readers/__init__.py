"""Readers: files of points → batches of points."""
