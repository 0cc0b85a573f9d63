"""Scenario files: reading, validation, faults and kills."""
