//! Replaces texts that identify a person, a machine or a network by tokens such as `<path-1>`. The same text becomes
//! the same token throughout, so that relations stay readable.

use std::borrow::Cow;
use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use regex_lite::Regex;
use serde_json::Value;

/// Kind of a replaced text; it gives the word in the token.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Kind {
    /// File or folder.
    Path,
    /// Name of a user.
    User,
    /// Name of a machine.
    Host,
    /// IP or MAC address.
    Address,
    /// Identity of one device.
    Serial,
    /// Password.
    Secret,
}

impl Kind {
    pub fn word(self) -> &'static str {
        match self {
            Kind::Path => "path",
            Kind::User => "user",
            Kind::Host => "host",
            Kind::Address => "address",
            Kind::Serial => "serial",
            Kind::Secret => "secret",
        }
    }
}

/// Replaces known texts and all text in the form of a path, a URL, an address or a host name.
#[derive(Default)]
pub struct Redactor {
    known: Vec<(String, Kind)>,
    tokens: HashMap<(Kind, String), usize>,
}

/// Pattern of a path. One of its components may hold up to two spaces, as `Program Files` does, if a slash follows.
const PATH: &str = r#"/(?:[^\s/"'`<>|:]*[^\s/"'`<>|:,;)](?: [^\s/"'`<>|:]*[^\s/"'`<>|:,;)]){0,2}/+)*[^\s/"'`<>|:]*"#;

static ABSOLUTE_PATH: LazyLock<Option<Regex>> = LazyLock::new(|| compile_anchored(&format!(r"(?:~\w*)?{PATH}")));
static REST_OF_PATH: LazyLock<Option<Regex>> = LazyLock::new(|| compile_anchored(PATH));
/// Paths that are the same on every machine: device nodes by the kernel's names, and the file of udev rules.
static PUBLIC_PATH: LazyLock<Option<Regex>> = LazyLock::new(|| {
    compile_anchored(
        r"(?:/dev/(?:tty[A-Za-z]{1,4}\d{1,3}|pts/\d+|hidraw\d+|bus/usb/\d+/\d+)|/(?:etc|run|lib|usr/lib)/udev/rules\.d/70-radome\.rules)",
    )
});
/// Pattern of a URL: scheme, login, host and port.
static URL: LazyLock<Option<Regex>> = LazyLock::new(|| {
    compile_anchored(r#"([A-Za-z][A-Za-z0-9+.-]*://)([^\s"'`<>]*@)?(\[[^\]\s]*\]|[^\s/:"'`<>@]*)(:\d+)?"#)
});
static LOGIN: LazyLock<Option<Regex>> = LazyLock::new(|| compile_anchored(r#"[^\s"'`<>(),;:/@\[\]]+@[\w.-]*\w"#));
static LOCAL_HOST_NAME: LazyLock<Option<Regex>> = LazyLock::new(|| {
    compile_anchored(
        r"(?i)\w[\w-]*(?:\.[\w-]+)*\.(?:local|lan|home|internal|intranet|corp|localdomain|fritz\.box|home\.arpa)\b",
    )
});
static IPV4: LazyLock<Option<Regex>> = LazyLock::new(|| compile_anchored(r"\d{1,3}(?:\.\d{1,3}){3}"));
static IPV6: LazyLock<Option<Regex>> = LazyLock::new(|| compile_anchored(r"[0-9A-Fa-f:.]*:[0-9A-Fa-f:.]*"));
static MAC: LazyLock<Option<Regex>> = LazyLock::new(|| {
    compile_anchored(r"(?:[0-9A-Fa-f]{2}(?:[:-][0-9A-Fa-f]{2}){5,7}|[0-9A-Fa-f]{4}\.[0-9A-Fa-f]{4}\.[0-9A-Fa-f]{4})")
});

/// Compiles a pattern that matches only at the beginning of a text. The patterns are constants; the tests compile them
/// all.
fn compile_anchored(pattern: &str) -> Option<Regex> {
    Regex::new(&format!(r"\A(?:{pattern})")).ok()
}

/// Returns the length of a pattern's match at the beginning of a text.
fn match_length(pattern: &Option<Regex>, text: &str) -> Option<usize> {
    pattern.as_ref()?.find(text).map(|found| found.end()).filter(|&length| length > 0)
}

/// Kind of name at the beginning of a text, and its length in bytes.
enum Match {
    /// Text that may be shown.
    Public(usize),
    /// Text that becomes a token.
    Hidden(usize, Kind),
    /// Lengths of a URL's scheme, login, host and port.
    Url([usize; 4]),
}

impl Match {
    fn length(&self) -> usize {
        match self {
            Match::Public(length) | Match::Hidden(length, _) => *length,
            Match::Url(lengths) => lengths.iter().sum(),
        }
    }
}

impl Redactor {
    /// Creates a redactor that knows this machine and its user: names, home, working folder, folder for temporary
    /// files.
    pub fn of_this_machine() -> Self {
        let mut redactor = Redactor::default();
        let home = std::env::var_os("HOME").map(PathBuf::from);
        for folder in [home, std::env::current_dir().ok(), Some(std::env::temp_dir())].iter().flatten() {
            redactor.hide_path(folder);
        }
        for variable in ["USER", "LOGNAME", "SUDO_USER"] {
            let user = std::env::var(variable).unwrap_or_default();
            // Names that many machines share identify nobody.
            if !["root", "radome"].contains(&user.as_str()) {
                redactor.hide(&user, Kind::User);
            }
        }
        let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        if host.trim() != "localhost" {
            redactor.hide(host.trim(), Kind::Host);
        }
        redactor
    }

    /// Replaces this text from now on where it is a separate word. A password of four characters or more is also
    /// replaced within words.
    pub fn hide(&mut self, text: &str, kind: Kind) {
        let is_public = text.len() < 2 || text == ".." || kind == Kind::Host && is_public_host(text);
        if !is_public && !self.known.iter().any(|(known, _)| known == text) {
            self.known.push((text.to_owned(), kind));
        }
    }

    /// Replaces a path as written, and all paths below it.
    pub fn hide_path(&mut self, path: &Path) {
        self.hide(&path.display().to_string(), Kind::Path);
    }

    /// Replaces the parts of a malformed broker address, since any of them may be a password.
    pub fn hide_url(&mut self, url: &str) {
        let rest = url.split_once("://").map_or(url, |(_, rest)| rest);
        self.hide(rest, Kind::Secret);
        if let Some((login, _)) = rest.rsplit_once('@') {
            self.hide(login, Kind::Secret);
            if let Some((_, password)) = login.split_once(':') {
                self.hide(password, Kind::Secret);
            }
        }
        for part in rest.split([':', '@', '/', '?', '#']) {
            // A number may be a port, which identifies nothing.
            if part.parse::<u16>().is_err() && !["mqtt", "mqtts", "tcp", "ssl"].contains(&part) {
                self.hide(part, Kind::Secret);
            }
        }
    }

    /// Number of different texts replaced, by kind.
    pub fn counts(&self) -> Vec<(Kind, usize)> {
        let mut counts = std::collections::BTreeMap::new();
        for (kind, _) in self.tokens.keys() {
            *counts.entry(*kind).or_insert(0) += 1;
        }
        counts.into_iter().collect()
    }

    /// Returns the text with tokens.
    pub fn text(&mut self, text: &str) -> String {
        // Passwords are replaced first: they may hold any character and occur within words.
        let is_secret = |known: &&(String, Kind)| known.1 == Kind::Secret && known.0.len() >= 4;
        let secrets = self.known.iter().filter(is_secret).map(|(secret, _)| secret);
        let Some(secret) = secrets.filter(|secret| text.contains(secret.as_str())).max_by_key(|s| s.len()).cloned()
        else {
            return self.replace_names(text);
        };
        let token = self.token(Kind::Secret, &secret);
        let parts: Vec<String> = text.split(secret.as_str()).map(|part| self.text(part)).collect();
        parts.join(token.as_str())
    }

    /// Replaces names in a text that holds no password.
    fn replace_names(&mut self, text: &str) -> String {
        let mut result = String::with_capacity(text.len());
        let mut previous: Option<char> = None;
        let mut rest = text;
        while let Some(next) = rest.chars().next() {
            let found = self.longest_match(rest, previous);
            let length = found.as_ref().map_or(next.len_utf8(), Match::length);
            let (matched, following) = rest.split_at(length);
            previous = matched.chars().last();
            match found {
                None | Some(Match::Public(_)) => result.push_str(matched),
                Some(Match::Hidden(_, kind)) => result.push_str(&self.token(kind, matched)),
                Some(Match::Url([scheme, login, host, _])) => {
                    result.push_str(&matched[..scheme]);
                    if login > 0 {
                        result.push_str(&self.token(Kind::User, &matched[scheme..scheme + login - 1]));
                        result.push('@');
                    }
                    let (host, port) = matched[scheme + login..].split_at(host);
                    match host.is_empty() || is_public_host(host) {
                        true => result.push_str(host),
                        false => result.push_str(&self.token(Kind::Host, host)),
                    }
                    result.push_str(port);
                    // The path of the URL is handled like any other path.
                    previous = None;
                }
            }
            rest = following;
        }
        result
    }

    /// Replaces names in the strings of a JSON value. Member names stay.
    pub fn json(&mut self, value: &mut Value) {
        match value {
            Value::String(text) => *text = self.text(text),
            Value::Array(values) => values.iter_mut().for_each(|value| self.json(value)),
            Value::Object(members) => members.values_mut().for_each(|value| self.json(value)),
            Value::Null | Value::Bool(_) | Value::Number(_) => {}
        }
    }

    /// Replaces names in lines of hexadecimal bytes. The bytes of known identities become `xx`.
    pub fn wire(&mut self, text: &str) -> String {
        let mut text = Cow::Borrowed(text);
        for (serial, _) in self.known.iter().filter(|(_, kind)| *kind == Kind::Serial) {
            for bytes in [hexadecimal(serial), hexadecimal_of_bytes(serial)] {
                // A message may be cut within an identity, so a prefix of four bytes or more is replaced too.
                for count in (4..=bytes.len()).rev() {
                    let end = if count == bytes.len() { "" } else { " and " };
                    let shown = bytes[..count].join(" ") + end;
                    if text.contains(&shown) {
                        text = Cow::Owned(text.replace(&shown, &(vec!["xx"; count].join(" ") + end)));
                    }
                }
            }
        }
        self.text(&text)
    }

    fn token(&mut self, kind: Kind, text: &str) -> String {
        let count = self.tokens.keys().filter(|(other, _)| *other == kind).count();
        let number = *self.tokens.entry((kind, text.to_lowercase())).or_insert(count + 1);
        format!("<{}-{number}>", kind.word())
    }

    /// Finds the longest text at the beginning that is to be replaced or kept whole.
    fn longest_match(&self, rest: &str, previous: Option<char>) -> Option<Match> {
        let is_within = previous.is_some_and(is_word);
        let known = self.known.iter().filter_map(|(text, kind)| match_known(rest, is_within, text, *kind));
        let mut matches: Vec<Match> = known.collect();
        if !is_within {
            matches.extend(match_forms(rest));
        }
        // Of equally long matches the known text wins; it comes first.
        matches.into_iter().reduce(|best, other| if other.length() > best.length() { other } else { best })
    }
}

/// Matches a known text at the beginning, where it is a separate word. A known path also covers all paths below it.
fn match_known(rest: &str, is_within: bool, text: &str, kind: Kind) -> Option<Match> {
    let matched = rest.get(..text.len()).filter(|matched| matched.eq_ignore_ascii_case(text))?;
    let following = &rest[matched.len()..];
    let is_part = |c: Option<char>| c.is_some_and(is_word);
    let continues_word = is_within && is_part(text.chars().next());
    if continues_word || is_part(following.chars().next()) && is_part(text.chars().last()) {
        return None;
    }
    let path_length = if kind == Kind::Path { match_length(&REST_OF_PATH, following).unwrap_or(0) } else { 0 };
    Some(Match::Hidden(text.len() + path_length, kind))
}

/// Returns whether a character belongs to a word or number.
fn is_word(c: char) -> bool {
    c.is_alphanumeric() || c == '_'
}

/// Finds names at the beginning of a text by their form. Only for the beginning of a word.
fn match_forms(rest: &str) -> Vec<Match> {
    let mut matches = Vec::new();
    let Some(first) = rest.chars().next() else { return matches };
    let ends_word = |length: usize| rest[length..].chars().next().is_none_or(|c| !is_word(c));
    if matches!(first, '/' | '~') {
        if let Some(length) = match_length(&PUBLIC_PATH, rest)
            .filter(|&length| ends_word(length) && !rest[length..].starts_with(['/', '-', '.']))
        {
            matches.push(Match::Public(length));
        } else if let Some(length) = match_length(&ABSOLUTE_PATH, rest) {
            // Punctuation at the end of a sentence does not belong to the path, and a single slash is not a path.
            let length = rest[..length].trim_end_matches(['.', ',', ';', ')', ']', '}']).len();
            matches.extend((length > 1).then_some(Match::Hidden(length, Kind::Path)));
        }
        return matches;
    }
    if let Some(parts) = (*URL).as_ref().and_then(|url| url.captures(rest)) {
        let length = |index: usize| parts.get(index).map_or(0, |part| part.len());
        matches.push(Match::Url([length(1), length(2), length(3), length(4)]));
    }
    matches.extend(match_length(&LOGIN, rest).map(|length| Match::Hidden(length, Kind::User)));
    matches.extend(match_length(&LOCAL_HOST_NAME, rest).map(|length| Match::Hidden(length, Kind::Host)));
    matches.extend(
        match_length(&MAC, rest).filter(|&length| ends_word(length)).map(|length| Match::Hidden(length, Kind::Address)),
    );
    let address = |length: usize| match is_public_host(&rest[..length]) {
        true => Match::Public(length),
        false => Match::Hidden(length, Kind::Address),
    };
    matches.extend(match_length(&IPV4, rest).filter(|&length| ends_word(length)).map(address));
    if let Some(length) = match_length(&IPV6, rest).filter(|&length| ends_word(length)) {
        // A colon after an address belongs to the sentence or precedes a port.
        let whole = (0..=length).rev().take(3).filter(|&end| rest.is_char_boundary(end));
        let parsed = whole.into_iter().find(|&end| rest[..end].parse::<Ipv6Addr>().is_ok());
        matches.extend(parsed.map(address));
    }
    matches
}

/// Returns whether a host is a loopback or unspecified address.
fn is_public_host(host: &str) -> bool {
    let host = host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host);
    let is_local = |address: IpAddr| address.is_loopback() || address.is_unspecified();
    host.eq_ignore_ascii_case("localhost") || host.parse::<IpAddr>().is_ok_and(is_local)
}

/// Decodes the bytes that a text writes in hexadecimal, without trailing zeros; empty if the text is not hexadecimal.
fn hexadecimal(text: &str) -> Vec<String> {
    if !text.len().is_multiple_of(2) || !text.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return Vec::new();
    }
    let pair = |at: usize| text[at..at + 2].to_ascii_lowercase();
    let mut bytes: Vec<String> = (0..text.len()).step_by(2).map(pair).collect();
    while bytes.last().is_some_and(|byte| byte == "00") {
        bytes.pop();
    }
    bytes
}

/// Encodes the bytes of the text itself in hexadecimal.
fn hexadecimal_of_bytes(text: &str) -> Vec<String> {
    text.bytes().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn redacted(text: &str) -> String {
        Redactor::default().text(text)
    }

    #[test]
    fn every_pattern_compiles() {
        for pattern in [&ABSOLUTE_PATH, &REST_OF_PATH, &PUBLIC_PATH, &URL, &LOGIN, &LOCAL_HOST_NAME, &IPV4, &IPV6, &MAC]
        {
            assert!(pattern.is_some());
        }
    }

    #[test]
    fn texts_in_the_form_of_names_become_tokens_and_others_stay() {
        for (text, expected) in [
            ("/home/bob/a.toml: bad", "<path-1>: bad"),
            ("cannot read /home/bob/a.toml from /srv/x.", "cannot read <path-1> from <path-2>."),
            ("~/a, ~bob/b", "<path-1>, <path-2>"),
            ("\"/home/Bob B Smith/a.toml\"", "\"<path-1>\""),
            ("(./x/y)", "(.<path-1>)"),
            ("folder: writes 437 MB/s, frames need 1/2", "folder: writes 437 MB/s, frames need 1/2"),
            (
                "/dev/ttyACM0: MCU7 on /dev/pts/3, bus /dev/bus/usb/001/004",
                "/dev/ttyACM0: MCU7 on /dev/pts/3, bus /dev/bus/usb/001/004",
            ),
            ("/dev/serial/by-id/usb-x", "<path-1>"),
            ("/etc/udev/rules.d/70-radome.rules", "/etc/udev/rules.d/70-radome.rules"),
            ("mqtt://u:p/w@q@hub.example:1883/x", "mqtt://<user-1>@<host-1>:1883<path-1>"),
            ("http://127.0.0.1:8060/", "http://127.0.0.1:8060/"),
            (
                "192.168.1.7:1883: refused by [fe80::1%eth0]:1883",
                "<address-1>:1883: refused by [<address-2>%eth0]:1883",
            ),
            ("fe80::1: no answer", "<address-1>: no answer"),
            ("127.0.0.1:8060 and ::1 are free", "127.0.0.1:8060 and ::1 are free"),
            ("aa:BB:cc:dd:ee:0f or aa-bb-cc-dd-ee-0f", "<address-1> or <address-2>"),
            ("bob@example.org at hub.fritz.box, Nas.Local", "<user-1> at <host-1>, <host-2>"),
            ("radome 0.1.0, x86_64, std::net, 12:30:45", "radome 0.1.0, x86_64, std::net, 12:30:45"),
            ("", ""),
        ] {
            assert_eq!(redacted(text), expected, "{text}");
        }
    }

    #[test]
    fn known_texts_are_found_as_words_and_one_text_has_one_token() {
        let mut redactor = Redactor::default();
        redactor.hide("pi", Kind::User);
        redactor.hide("barn", Kind::Host);
        redactor.hide("hunter2", Kind::Secret);
        redactor.hide("My Scene.toml", Kind::Path);
        redactor.hide_path(Path::new("/home/Bob Smith"));
        assert_eq!(redactor.text("pi on Barn, spin, barns"), "<user-1> on <host-1>, spin, barns");
        assert_eq!(redactor.text("xhunter2x mqtt://pi@barn"), "x<secret-1>x mqtt://<user-1>@<host-1>");
        assert_eq!(redactor.text("My Scene.toml: no room"), "<path-1>: no room");
        assert_eq!(redactor.text("in /home/Bob Smith/x y/z.stl"), "in <path-2>");
        assert_eq!(redactor.text("in /home/Bob Smith"), "in <path-3>");
        let mut value = serde_json::json!({ "pi": ["at barn", 3, { "found": "/home/Bob Smith" }] });
        redactor.json(&mut value);
        assert_eq!(value, serde_json::json!({ "pi": ["at <host-1>", 3, { "found": "<path-3>" }] }));
        assert_eq!(redactor.counts(), [(Kind::Path, 3), (Kind::User, 1), (Kind::Host, 1), (Kind::Secret, 1)]);
    }

    #[test]
    fn bytes_of_an_identity_are_hidden_also_where_a_message_is_cut() {
        let mut redactor = Redactor::default();
        redactor.hide("0a0b0c0d0e0f0000", Kind::Serial);
        redactor.hide("SN42", Kind::Serial);
        let wire =
            "    0.1 < 01 00 0a 0b 0c 0d 0e 0f 00 00\n    0.2 < 0a 0b 0c 0d and 9 bytes\n    0.3 > 53 4e 34 32 01\n";
        assert_eq!(
            redactor.wire(wire),
            "    0.1 < 01 00 xx xx xx xx xx xx 00 00\n    0.2 < xx xx xx xx and 9 bytes\n    0.3 > xx xx xx xx 01\n"
        );
        assert_eq!(redactor.wire("    0.4 opened /dev/pts/7\n"), "    0.4 opened /dev/pts/7\n");
    }

    mod hard_cases {
        use proptest::prelude::*;

        use super::*;

        /// Text with an identifying name, its kind if known beforehand, and the part that must be hidden.
        type Named = (String, Option<Kind>, String);

        /// Creates a text that is recognised by its form only.
        fn formed(shown: String, hidden: String) -> Named {
            (shown, None, hidden)
        }

        fn named() -> impl Strategy<Value = Named> {
            let name = "zq[a-z0-9]{4,12}";
            prop_oneof![
                (name, "[a-z./-]{0,8}").prop_map(|(n, end)| formed(format!("/home/{n}/{end}"), n)),
                (name, name).prop_map(|(n, m)| formed(format!("/srv/{m} of {n}/a.toml"), n)),
                (name, "[!#-&(-;=?-_a-~]{0,6}").prop_map(|(n, p)| formed(format!("mqtt://u:{n}{p}@hub:1883"), n)),
                name.prop_map(|n| formed(format!("mqtts://{n}.example.com"), n)),
                name.prop_map(|n| formed(format!("{n}@example.com"), n)),
                name.prop_map(|n| formed(format!("{n}.local"), n)),
                (1u8..127, any::<[u8; 3]>(), any::<u16>()).prop_map(|(a, [b, c, d], port)| {
                    let address = std::net::Ipv4Addr::new(a, b, c, d).to_string();
                    formed(format!("{address}:{port}"), address)
                }),
                any::<[u16; 8]>().prop_map(|parts| {
                    let address = Ipv6Addr::from(parts.map(|part| part | 0x1000)).to_string();
                    formed(format!("[{address}]:8883"), address)
                }),
                any::<[u8; 6]>().prop_map(|bytes| {
                    let text = bytes.map(|byte| format!("{byte:02X}")).join(":");
                    formed(text.clone(), text)
                }),
                "[ -~äéß€]{4,16}".prop_map(|text| (text.clone(), Some(Kind::Secret), text)),
                (name, prop::sample::select(vec![Kind::User, Kind::Host, Kind::Serial, Kind::Path]))
                    .prop_map(|(text, kind)| (text.clone(), Some(kind), text)),
            ]
        }

        proptest! {
            /// No name survives at any position in a text.
            #[test]
            fn no_name_survives(
                names in prop::collection::vec(named(), 1..4),
                between in prop::collection::vec(prop::sample::select(vec![" ", ", ", "\n", " (", "\"", " = ", "; ", "' "]), 5),
            ) {
                let mut redactor = Redactor::default();
                let mut text = String::from("cannot open");
                for ((shown, known, _), between) in names.iter().zip(&between) {
                    text += between;
                    text += shown;
                    if let Some(kind) = known {
                        redactor.hide(shown, *kind);
                    }
                }
                text += " here";
                let result = redactor.text(&text);
                for (_, _, hidden) in &names {
                    // Text that occurs in a token or in the sentence itself is not secret.
                    let is_said = ["cannot open", " here", "<secret-", "@<host-", "/home/"].iter().any(|said| said.contains(hidden.as_str()));
                    prop_assert!(is_said || !result.contains(hidden.as_str()), "{text}\n{result}");
                }
            }

            #[test]
            fn nothing_is_refused(text in any::<String>(), known in any::<String>()) {
                let mut redactor = Redactor::of_this_machine();
                redactor.hide(&known, Kind::Secret);
                redactor.hide_url(&known);
                redactor.wire(&text);
            }
        }
    }
}
