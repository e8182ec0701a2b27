//! A configuration file with any content.
//!
//! Input: the file; bytes that are not UTF-8 are replaced.

use drivegate_gateway::config::Settings;

pub(crate) fn run(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    // Such a value would name files and devices of this machine, so it is skipped.
    if ["password_file", "profile_dirs", "certificate", "key", "ca=", "ca =", "\"ca\""].iter().any(|word| text.contains(word)) {
        return;
    }
    let loaded = Settings::parse("fuzz.toml", &text, std::iter::empty());
    assert_eq!(loaded.settings.is_some(), loaded.errors.is_empty());
    for problem in loaded.errors.iter().chain(&loaded.warnings) {
        assert!(!problem.to_string().is_empty());
    }
    let again = Settings::parse("fuzz.toml", &text, std::iter::empty());
    assert_eq!(loaded.settings, again.settings);
}
