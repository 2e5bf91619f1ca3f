//! What the program promises, tested from outside: through the command, and through the library.

mod oracle; // the method against the paper's algorithms on a plain dense grid, in double precision
mod shapes; // particles to skin, the method with its defaults, and level sets read at a place
