"""The subcommands: one file each, a function whose arguments are the options."""
