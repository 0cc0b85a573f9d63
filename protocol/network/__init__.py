"""Zenoh keys, access rules, sessions and endpoints."""
