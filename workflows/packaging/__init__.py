"""The build of the library as a package."""
