"""The commands of the command line, by what they are about; `lungaccess.cli.app` puts them together."""
