"""Generators of the shipped car and of the sample vehicle files."""
