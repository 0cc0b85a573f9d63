"""A record in the formats of other people's tools: MCAP, parquet and CSV."""
