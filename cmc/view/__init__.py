"""Plots, sliders and 3D playback: arrays in, pictures out."""
