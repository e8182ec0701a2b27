//! Drives and meters by a user's own profile.

use super::*;
use drivegate_testkit::Order::Single;

fn profile(text: &str) -> Arc<Profile> {
    let text = format!("name = \"p\"\nprotocols = [\"modbus-rtu\"]\n{text}");
    Arc::new(Profile::parse("p.toml", &text, false).unwrap_or_else(|why| panic!("{why:?}")))
}

const RANGE: &str = "[[range]]\ntable = \"holding\"\nfirst = 0\nlast = 19\nread = 8\nwrite = 2\n";

/// A drive without hand-written words follows its own profile.
#[test]
fn a_profile_of_ones_own() {
    let text = format!(
        "{RANGE}[ranges]\nsingle_write = 16\n\
         [control]\nat = \"holding 0\"\nalways = {{ set = [10] }}\n\
         run = {{ steps = [{{ write = 0x0406, until = {{ point = \"status_word\", mask = 0x6F, is = 0x21 }} }}, {{ write = 0x0407, time = \"200ms\" }}, {{ write = 0x040F }}] }}\n\
         stop = {{ bit = 3, is = 0 }}\nreverse = {{ bit = 11 }}\nfault_reset = {{ mask = 0x88, value = 0x80 }}\n\
         [[state]]\nis = \"running\"\npoint = \"status_word\"\nmask = 0x6F\nvalue = 0x27\n\
         [[state]]\nis = \"fault\"\npoint = \"status_word\"\nmask = 0x4F\nvalue = 0x08\n\
         [[point]]\nname = \"status_word\"\nat = \"holding 3\"\nclass = \"fast\"\nhidden = true\n\
         [[point]]\nname = \"output_frequency\"\nat = \"holding 4\"\ntype = \"i16\"\nscale = 0.1\nclass = \"fast\"\n\
         [[point]]\nname = \"frequency_reference\"\nat = \"holding 1\"\ntype = \"i16\"\nscale = 0.1\nwrite = true\nrange = [0, 50]\n"
    );
    let text =
        text.replace(RANGE, "").replace("[ranges]\nsingle_write = 16\n", "") + "[ranges]\nsingle_write = 16\n" + RANGE;
    let mut rig = ProfiledDrive::of(&profile(&text));
    let refused = rig.ask(&Word(0, 0x0406).pdu());
    assert_eq!(refused, Reply::Exception(Exception::FUNCTION), "function 16 only");
    let status = |rig: &mut ProfiledDrive| rig.register(Table::Holding, 3) & 0x6F;
    rig.send(&[Single(1, 250), Single(0, 0x040F), Single(0, 0x0407)]);
    assert!(!rig.drive.state().running, "not prepared");
    assert_ne!(status(&mut rig), 0x21);
    assert_eq!(rig.ask(&Single(0, 0x0406).pdu()), Reply::Written);
    rig.wait(10);
    assert_ne!(status(&mut rig), 0x21, "that takes a while");
    rig.wait(30);
    assert_eq!(status(&mut rig), 0x21);
    // The second step needs time to complete, so these writes come too early.
    rig.send(&[Single(0, 0x0407), Single(0, 0x040F)]);
    assert!(!rig.drive.state().running);
    rig.wait(200);
    rig.send(&[Single(0, 0x0006)]);
    assert!(!rig.drive.state().running, "a word without bit 10 is no step");
    rig.send(&[Single(0, 0x0406), Single(0, 0x0407)]);
    rig.wait(200);
    rig.send(&[Single(0, 0x0C0F)]);
    rig.wait(3000);
    assert_eq!((rig.output(), status(&mut rig)), (-25.0, 0x27));
    assert_eq!(rig.register(Table::Holding, 4) as i16, -250);
    rig.send(&[Word(rig.trip_address, 9)].map(|order| match order {
        Word(address, value) => Single(address, value),
        other => other,
    }));
    assert_eq!(rig.drive.state().fault, 9);
    assert_eq!(rig.register(Table::Holding, 3) & 0x4F, 0x08);
    rig.send(&[Single(0, 0x0480)]);
    assert_eq!(rig.drive.state().fault, 0);
    assert!(!rig.drive.state().running);
}

/// A meter has the given values, settings within their range, texts, and a scale in another register.
#[test]
fn a_meter_holds_what_it_was_given() {
    let text = format!(
        "{RANGE}[[point]]\nname = \"voltage\"\nat = \"holding 0\"\ntype = \"f32\"\nunit = \"V\"\nclass = \"fast\"\n\
         [[point]]\nname = \"exponent\"\nat = \"holding 2\"\ntype = \"i16\"\n\
         [[point]]\nname = \"power\"\nat = \"holding 3\"\ntype = \"i16\"\nscale_from = \"exponent\"\nunit = \"kW\"\n\
         [[point]]\nname = \"serial\"\nat = \"holding 4\"\ntype = \"string:4\"\n\
         [[point]]\nname = \"ratio\"\nat = \"holding 8\"\nwrite = true\nrange = [1, 100]\n\
         [[point]]\nname = \"tariff\"\nat = \"holding 9\"\nwrite = true\ntexts = {{ 1 = \"day\", 2 = \"night\" }}\n"
    );
    let text = text.replace(RANGE, "") + RANGE;
    let meter = profile(&text);
    let mut options = ProfileOptions::new(&meter);
    let index = |name: &str| meter.point_index(name).unwrap();
    options.values.insert(index("voltage"), Given::Number(231.5));
    options.values.insert(index("exponent"), Given::Number(-1.0));
    options.values.insert(index("power"), Given::Number(12.3));
    options.values.insert(index("serial"), Given::Text("AB12".to_string()));
    let mut drive = ProfileDrive::new(options, SimTime::ZERO);
    let read = RequestPdu::read(Table::Holding, 0, 8);
    let words = drive.answer(&read, SimTime::ZERO).unwrap().into_words().unwrap();
    assert_eq!(words[..2], [0x4367, 0x8000], "231.5 as IEEE 754");
    assert_eq!(words[2..4], [0xFFFF, 123]);
    assert_eq!(words[4..8], [0x4142, 0x3132, 0, 0]);
    let mut write = |order: Order| drive.answer(&order.pdu(), SimTime::ZERO).unwrap();
    assert_eq!(write(Word(8, 0)), Reply::Exception(Exception::VALUE), "below its range");
    assert_eq!(write(Word(8, 7)), Reply::Written);
    assert_eq!(write(Word(9, 3)), Reply::Exception(Exception::VALUE), "no text");
    assert_eq!(write(Word(9, 2)), Reply::Written);
}

/// A last step that waits for a state reaches it, a masked state is shown shifted, and of two directions only one is shown.
#[test]
fn states_of_a_profile_of_ones_own() {
    let text = format!(
        "[control]\nat = \"holding 0\"\nown_word = \"shadow\"\nstop = {{ mask = 3, value = 0 }}\n\
         run = {{ steps = [{{ write = 1, until = {{ point = \"status_word\", mask = 0x300, is = 0x100 }} }}, \
         {{ write = 3, until = {{ point = \"status_word\", mask = 0x300, is = 0x200 }} }}] }}\nreverse = {{ bit = 2 }}\n\
         [[state]]\nis = \"running\"\npoint = \"status_word\"\nmask = 0x09\nvalue = 0x01\n\
         [[state]]\nis = \"running\"\npoint = \"status_word\"\nmask = 0x0A\nvalue = 0x02\n\
         [[point]]\nname = \"status_word\"\nat = \"holding 3\"\nclass = \"fast\"\nhidden = true\n\
         [[point]]\nname = \"reversed\"\nat = \"holding 3.1\"\nclass = \"fast\"\n\
         [[point]]\nname = \"fault\"\nat = \"holding 3\"\nmask = 0x30\nequals = 3\nclass = \"fast\"\n\
         [[point]]\nname = \"frequency_reference\"\nat = \"holding 1\"\nscale = 0.1\nwrite = true\nrange = [0, 50]\n{RANGE}"
    );
    let mut rig = ProfiledDrive::of(&profile(&text));
    let status = |rig: &mut ProfiledDrive| rig.register(Table::Holding, 3);
    rig.send(&[Word(1, 250), Word(0, 1)]);
    assert_eq!(status(&mut rig) & 0x300, 0x100);
    rig.send(&[Word(0, 3)]);
    rig.wait(3000);
    assert_eq!(status(&mut rig) & 0x33B, 0x201);
    rig.send(&[Word(0, 0)]);
    rig.wait(3000);
    assert_eq!(status(&mut rig) & 3, 0);
    rig.send(&[Word(0, 5), Word(0, 7)]);
    rig.wait(3000);
    assert_eq!(status(&mut rig) & 0x33B, 0x202, "in reverse, and not forward");
    rig.send(&[Word(rig.trip_address, 1)]);
    assert_eq!(status(&mut rig) & 0x30, 0x30, "the equal of a mask is shifted");
}
