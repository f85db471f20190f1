//! Messages on stderr.

/// Writes a line to stderr. A stderr that is closed or full stops nothing; `eprintln!` would panic.
macro_rules! message {
    ($($text:tt)*) => {{
        let _ = std::io::Write::write_fmt(&mut std::io::stderr(), format_args!("{}\n", format_args!($($text)*)));
    }};
}
