"""Plays and counts trials, and compares networks by them."""
