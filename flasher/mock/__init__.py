"""Device model: bootloader, flash and applications, written from the documents alone."""
