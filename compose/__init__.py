"""Puts processes together: scenarios, launching, records, the command line."""
