"""Results of a diagnosis: files, words, the HTML page, and a proposal for the next experiment."""
