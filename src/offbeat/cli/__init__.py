"""The subcommands: one file each, with a function whose arguments are the options."""
