"""The commands of the command line, one module each; `lungaccess.cli` puts them together."""
