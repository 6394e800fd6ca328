"""What every other package stands on: errors, files, settings, words of strangers, processes, progress."""
