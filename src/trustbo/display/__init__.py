"""Objects as a person looks at them: text in a terminal, HTML in a notebook."""
