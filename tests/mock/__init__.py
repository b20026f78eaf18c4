"""What flasher.mock promises: a bootloader as the document describes it, on strict flash."""
