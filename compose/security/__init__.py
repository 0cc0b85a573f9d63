"""Certificates and access rules for missions over networks that are not trusted."""
