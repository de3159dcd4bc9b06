"""The model of a record: its parameters and gradient, filters, roots and correlations.

May import what ``identification`` may import.
"""
