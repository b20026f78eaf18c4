"""The command line: arguments, printing, progress bars, exit codes; nothing else prints."""
