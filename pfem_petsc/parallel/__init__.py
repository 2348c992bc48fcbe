"""What all ranks do together: agreeing on errors, moving arrays between numberings."""
