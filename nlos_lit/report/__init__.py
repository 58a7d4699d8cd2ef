"""The answer shown: figures, words, verdict, page."""
