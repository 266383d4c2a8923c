"""Contraction, auxiliary spaces, combinations and certificates (numpy and scipy only)."""
