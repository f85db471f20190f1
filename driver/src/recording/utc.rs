//! Dates in UTC.

/// Year, month, day, hour, minute and second. The date by H. Hinnant, "chrono-compatible low-level date algorithms",
/// `civil_from_days`.
fn civil(unix_s: u64) -> [u64; 6] {
    let (days, second) = (unix_s / 86_400 + 719_468, unix_s % 86_400);
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
    let year = era * 400 + year_of_era + u64::from(month <= 2);
    [year, month, day, second / 3600, second / 60 % 60, second % 60]
}

/// Formats a time as in JSON files of the vendor: `2026-11-22T21:22:00+0000`.
pub fn iso_8601(unix_s: u64) -> String {
    let [year, month, day, hour, minute, second] = civil(unix_s);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}+0000")
}

/// Formats a time for the name of a file: `20261122T212200Z`. Names sort by time.
pub fn file_stamp(unix_s: u64) -> String {
    let [year, month, day, hour, minute, second] = civil(unix_s);
    format!("{year:04}{month:02}{day:02}T{hour:02}{minute:02}{second:02}Z")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Compares with `date -u -d @SECONDS +%FT%T+0000`.
    #[test]
    fn dates_are_those_of_the_calendar() {
        for (unix_s, date) in [
            (0, "1970-01-01T00:00:00+0000"),
            (951_782_399, "2000-02-28T23:59:59+0000"),
            (951_868_800, "2000-03-01T00:00:00+0000"),
            (1_767_683_775, "2026-01-06T07:16:15+0000"),
        ] {
            assert_eq!(iso_8601(unix_s), date);
        }
        assert_eq!(file_stamp(1_767_683_775), "20260106T071615Z");
    }
}
