"""flasher.protocol, compared with the documents' own bytes and with plain references."""
