"""Experiments: excitations, measured records and their files, frequency responses.

May import what ``identification`` may import.
"""
