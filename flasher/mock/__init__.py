"""Device model, written from the documents: shares only `flasher.protocol` with the host."""
