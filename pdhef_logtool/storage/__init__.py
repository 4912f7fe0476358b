"""Files, folders, object stores and documents: complete or absent."""
