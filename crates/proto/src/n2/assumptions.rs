//! Assumptions about N2 that no manual confirms, collected here. None of them was verified on hardware.
//!
//! Johnson Controls' own specification is not public, and the manuals of the drives print no frames. The basis of
//! the frames, and what may differ with a real drive, is listed in [`ASSUMPTIONS`]; everything that matters to the
//! master is an option of a profile, section `[n2]`.

use std::time::Duration;

/// Digits of the region in override and release.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RegionWidth {
    /// `723…`.
    One,
    /// `7203…`.
    Two,
}

impl RegionWidth {
    /// The number of digits in profiles.
    pub fn digits(self) -> u8 {
        match self {
            RegionWidth::One => 1,
            RegionWidth::Two => 2,
        }
    }
}

/// The N2 options of a profile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct N2Options {
    /// Bit of the status byte of BI and BO that is the state, 0..=7.
    pub state_bit: u8,
    /// Bit of that byte which marks the state as unreliable; `None` ignores it.
    pub unreliable_bit: Option<u8>,
    /// Digits of the region in override and release.
    pub region_width: RegionWidth,
    /// Number on the wire of the object that the maps call 1: some families count from 0.
    pub first_object: u8,
    /// Whether drives are identified before the first request, and again after a transaction that failed.
    pub identify: bool,
    /// Device type that a drive is expected to report.
    pub device_type: u8,
    /// An overridden analog output is released afterwards.
    pub release: bool,
    /// Pause between two polls for changes; a drive that is not polled considers itself disconnected after about 10
    /// minutes.
    pub poll: Duration,
}

impl N2Options {
    /// The default N2 options.
    pub const DEFAULT: N2Options = N2Options {
        state_bit: 6,
        unreliable_bit: None,
        region_width: RegionWidth::Two,
        first_object: 1,
        identify: true,
        device_type: 0x10,
        release: true,
        poll: Duration::from_secs(30),
    };
}

impl Default for N2Options {
    fn default() -> Self {
        N2Options::DEFAULT
    }
}

/// Bit of a configuration byte that switches the report of changes on; simulator only.
pub const CONFIG_REPORT_BIT: u8 = 0;
/// Bit of a status byte that shows an override; simulator only.
pub const STATUS_OVERRIDE_BIT: u8 = 5;
/// Value that the simulator sends for a limit that is switched off.
pub const INVALID_FLOAT: u32 = 0x7FC0_0000;

/// A behaviour of N2 drives that no manual specifies.
#[derive(Debug, Clone, Copy)]
pub struct Assumption {
    /// Key of `[n2]` in a profile that changes the assumption; `None` if it need not be changed.
    pub key: Option<&'static str>,
    /// The assumption, as text.
    pub what: &'static str,
    /// The reason for the assumption.
    pub why: &'static str,
    value: fn(&N2Options) -> String,
}

impl Assumption {
    /// The value in force with these options, as a profile would write it if there is a key.
    pub fn value(&self, options: &N2Options) -> String {
        (self.value)(options)
    }
}

macro_rules! assumptions {
    ($($key:expr, $what:literal, $why:literal, $value:expr;)*) => {
        /// All assumptions, those with a key first.
        pub const ASSUMPTIONS: &[Assumption] = &[$(Assumption { key: $key, what: $what, why: $why, value: $value },)*];
    };
}

assumptions! {
    Some("state_bit"), "bit of the BI and BO status byte that holds the state",
        "the manuals name the bit but not its position", |o| o.state_bit.to_string();
    Some("unreliable_bit"), "bit of that byte that marks the state as unreliable; such a state is not served",
        "the manuals name the bit but not its position (7 is likely), and these drives are always reliable",
        |o| o.unreliable_bit.map_or("none".to_string(), |bit| bit.to_string());
    Some("region_width"), "digits of the region in override and release",
        "one open-source master sends 2, but 1 in reads and writes", |o| o.region_width.digits().to_string();
    Some("identify"), "a drive replies to nothing before Identify, so Identify is sent first",
        "stated by TECO and others; the frame is from one open-source master", |o| o.identify.to_string();
    Some("device_type"), "device type that the drive reports; any other causes a warning",
        "Danfoss, Rockwell and ProSoft document 10h for non-JCI devices", |o| format!("0x{:02X}", o.device_type);
    Some("release"), "an overridden AO is released at once",
        "recommended by Vacon and Eaton; TECO acknowledges it without effect", |o| o.release.to_string();
    Some("poll"), "interval of polls for changes",
        "Vacon and Eaton release overrides after about 10 minutes without a poll",
        |o| humantime::format_duration(o.poll).to_string();
    None, "checksum: sum of the characters after the lead character, modulo 256",
        "one open-source master; matches printed frames of a related protocol", |_| "sum".to_string();
    None, "no changes: an acknowledgement without data",
        "one open-source master", |_| "A".to_string();
    None, "report of changes: any data means that something changed and the drive is read",
        "no source describes the layout; the simulator sends region, number, status and value", |_| "any".to_string();
    None, "reports are fetched with poll 0/4 first, then 0/5, at most 16",
        "one source each for the order and for the acknowledgement", |_| "0/4, 0/5".to_string();
    None, "a reply to a read may have one byte before the value; it is ignored",
        "devices differ", |_| "both".to_string();
    None, "a refusal has no checksum; one with a checksum is accepted too",
        "one open-source master expects none", |_| "both".to_string();
    None, "any NaN or infinity means no value",
        "the manuals name an Invalid Float without its bit pattern; the simulator sends 7FC00000", |_| "no value".to_string();
    None, "object numbers on the wire are those of the printed maps, from 1",
        "the manuals print no frames", |_| "from 1".to_string();
    None, "time is not synchronised",
        "no source describes the payload", |_| "never sent".to_string();
    None, "bit 0 of a configuration byte enables reports, bit 5 of a status byte indicates an override",
        "simulator only: the manuals name the bits but not their positions", |_| "0, 5".to_string();
    None, "an override of ADI takes 4 digits, of BD 2",
        "simulator only: by analogy", |_| "4, 2".to_string();
}
