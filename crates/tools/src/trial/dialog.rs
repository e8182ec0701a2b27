//! Questions to the user on the terminal.

use std::io::{self, BufRead, IsTerminal, Write};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError, mpsc};
use std::time::Duration;

use super::Stop;
use crate::adapters::{Adapter, adapters};
use crate::failure::Failure;
use crate::printable;

/// Interval at which a signal is noticed.
const LOOK: Duration = Duration::from_millis(50);

/// Whether a person can be asked.
pub(super) fn is_terminal() -> bool {
    io::stdin().is_terminal() && io::stderr().is_terminal()
}

/// The lines that are typed. One thread reads them all, because a read from the terminal cannot be broken off: what is typed after
/// a question that is over would answer the next one too late.
pub(super) struct Keyboard(Mutex<mpsc::Receiver<String>>);

impl Keyboard {
    /// Reads from now on; the thread ends with the input or the process.
    pub(super) fn open() -> Keyboard {
        let (sender, lines) = mpsc::channel();
        if is_terminal() {
            std::thread::spawn(move || {
                let mut line = String::new();
                while io::stdin().lock().read_line(&mut line).is_ok_and(|count| count > 0) {
                    if sender.send(line.trim().to_string()).is_err() {
                        return;
                    }
                    line.clear();
                }
            });
        }
        Keyboard(Mutex::new(lines))
    }

    /// The next line, for `time` at most.
    fn next(&self, time: Duration) -> Result<String, mpsc::RecvTimeoutError> {
        let lines = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        lines.recv_timeout(time)
    }

    /// The answer to a question; `None` at the end of the input or after a signal.
    pub(super) fn ask(&self, question: &str, stop: &Stop) -> Option<String> {
        let mut stderr = io::stderr().lock();
        let _ = write!(stderr, "{question} ").and_then(|()| stderr.flush());
        drop(stderr);
        while !stop.is_wanted() {
            match self.next(LOOK) {
                Ok(answer) => return Some(answer),
                Err(mpsc::RecvTimeoutError::Timeout) => {}
                Err(mpsc::RecvTimeoutError::Disconnected) => return None,
            }
        }
        let _ = writeln!(io::stderr().lock());
        None
    }

    /// Sets `enough` at each line that is typed while `work` runs.
    pub(super) fn during<T>(&self, enough: &AtomicBool, work: impl FnOnce() -> T) -> T {
        let done = AtomicBool::new(false);
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !done.load(Ordering::Relaxed) {
                    match self.next(LOOK) {
                        Ok(_) => enough.store(true, Ordering::Relaxed),
                        Err(mpsc::RecvTimeoutError::Timeout) => {}
                        Err(mpsc::RecvTimeoutError::Disconnected) => return,
                    }
                }
            });
            let outcome = work();
            done.store(true, Ordering::Relaxed);
            outcome
        })
    }
}

/// Lists the adapters and asks which one to use; `None` after a signal.
///
/// # Errors
/// If there is no adapter, or no terminal for the question.
pub(super) fn choose_port(stop: &Stop, keyboard: &Keyboard) -> Result<Option<String>, Failure> {
    let found = adapters();
    if found.is_empty() {
        return Err(
            "no serial adapter is plugged in; /dev/serial/by-id and /sys/class/tty; plug one in, or write \
             --port tcp://host:port for a device server"
                .into(),
        );
    }
    let _ = write!(io::stderr().lock(), "{}", list(&found));
    if !is_terminal() {
        return Err(Failure::Misused(format!(
            "no adapter is named, and there is no terminal to ask on; command line; write --port {}",
            found.first().map_or("PORT", |adapter| adapter.port.as_str())
        )));
    }
    loop {
        let Some(answer) = keyboard.ask(&question(found.len()), stop) else {
            return Ok(None);
        };
        match chosen(&answer, &found) {
            Some(adapter) => return Ok(Some(adapter.port.clone())),
            None => drop(writeln!(
                io::stderr().lock(),
                "Write a number from 1 to {}.",
                found.len()
            )),
        }
    }
}

fn list(adapters: &[Adapter]) -> String {
    let one = |(number, adapter): (usize, &Adapter)| {
        let device = adapter.device.as_ref().map(|device| format!(" ({device})"));
        printable::line(&format!("  {number}  {}{}", adapter.port, device.unwrap_or_default())) + "\n"
    };
    "Serial adapters of this machine:\n".to_string() + &(1..).zip(adapters).map(one).collect::<String>()
}

fn question(count: usize) -> String {
    match count {
        1 => "Which one? [1]".to_string(),
        more => format!("Which one? 1 to {more}:"),
    }
}

/// The adapter of that number; without an answer the only one.
fn chosen<'a>(answer: &str, adapters: &'a [Adapter]) -> Option<&'a Adapter> {
    match (answer, adapters) {
        ("", [only]) => Some(only),
        _ => answer
            .parse::<usize>()
            .ok()
            .and_then(|number| adapters.get(number.checked_sub(1)?)),
    }
}

/// Refuses a file that exists.
pub(super) fn check_new(file: &Path) -> Result<(), String> {
    match file.symlink_metadata() {
        Ok(_) => Err(format!(
            "{} exists already; it is left as it is; choose another name",
            file.display()
        )),
        Err(_) => Ok(()),
    }
}

/// Writes a new file.
pub(super) fn write_new(file: &Path, text: &str) -> Result<(), String> {
    check_new(file)?;
    let opened = std::fs::File::options().write(true).create_new(true).open(file);
    let written = opened.and_then(|mut opened| {
        // An incomplete file would prevent the next attempt.
        let remove = |_: &std::io::Error| drop(std::fs::remove_file(file));
        opened.write_all(text.as_bytes()).inspect_err(remove)
    });
    written.map_err(|why| {
        format!(
            "cannot write {}: {why}; choose another name or directory",
            file.display()
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_adapter_is_chosen_by_its_number() {
        let adapter = |port: &str, device: Option<&str>| Adapter {
            port: port.to_string(),
            device: device.map(ToString::to_string),
        };
        let two = [
            adapter("/dev/serial/by-id/a", Some("/dev/ttyUSB0")),
            adapter("/dev/ttyS0", None),
        ];
        assert_eq!(
            list(&two),
            "Serial adapters of this machine:\n  1  /dev/serial/by-id/a (/dev/ttyUSB0)\n  2  /dev/ttyS0\n"
        );
        assert_eq!(chosen("2", &two).unwrap().port, "/dev/ttyS0");
        for bad in ["", "0", "3", "a", "-1"] {
            assert_eq!(chosen(bad, &two), None, "{bad}");
        }
        assert_eq!(chosen("", &two[..1]).unwrap().port, "/dev/serial/by-id/a");
    }

    #[test]
    fn nothing_is_overwritten() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("drivegate.toml");
        write_new(&file, "first").unwrap();
        let refused = write_new(&file, "second").unwrap_err();
        assert!(refused.contains("exists already"), "{refused}");
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "first");
        let link = dir.path().join("link.toml");
        std::os::unix::fs::symlink("nowhere", &link).unwrap();
        assert!(
            check_new(&link).is_err(),
            "a link that leads nowhere is a name that is taken"
        );
        assert!(
            write_new(&dir.path().join("none/a.toml"), "")
                .unwrap_err()
                .contains("cannot write")
        );
    }
}
