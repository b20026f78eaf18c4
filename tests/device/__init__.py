"""What flasher.device promises: a bootloader as the document describes it, on strict flash."""
