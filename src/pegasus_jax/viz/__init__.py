"""What a person looks at: pictures, tables and films of a run."""
