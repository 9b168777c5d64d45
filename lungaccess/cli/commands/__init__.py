"""The commands of the command line, one module each; `lungaccess.cli.app` puts them together."""
