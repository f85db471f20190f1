//! Words of shell commands that the program prints or writes.

/// Formats a text as one word of a POSIX shell.
pub fn word(text: &str) -> String {
    let is_plain = |letter: char| letter.is_ascii_alphanumeric() || "_./+-:@%,=".contains(letter);
    if !text.is_empty() && text.chars().all(is_plain) {
        return text.to_owned();
    }
    format!("'{}'", text.replace('\'', "'\\''"))
}

/// Formats a command as one line of a comment, which a line's end would end.
pub fn comment(command: &str) -> String {
    command.replace(char::is_control, "?")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A name with a line's end broke the head of a mirror's scene file.
    #[test]
    fn a_command_of_any_names_is_one_line_of_a_comment() {
        let command = format!("radome scene pair {} {}", word("a b\n[room]"), word("it's.toml"));
        assert_eq!(comment(&command), r"radome scene pair 'a b?[room]' 'it'\''s.toml'");
    }
}
