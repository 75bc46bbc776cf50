"""The four stages in a row, for data sets, two photographs, a folder of them, and matches alone."""
