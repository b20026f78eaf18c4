"""The upgrade host, with the test in the place of the device."""
