"""Command line: arguments, output, progress bars, exit codes. No other package prints."""
