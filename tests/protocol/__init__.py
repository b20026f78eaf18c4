"""What flasher.protocol promises, held against the documents' own bytes and plain references."""
