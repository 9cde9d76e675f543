"""The pages of the library of problems with proven optima."""
