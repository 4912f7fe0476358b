"""Everything that is known of one vehicle."""
