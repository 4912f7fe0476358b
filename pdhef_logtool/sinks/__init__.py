"""What a run leaves: Parquet tables, annotated MCAP, Rerun recording, reports."""
