"""What every room stands on: errors, the registry, documents, files, tables."""
