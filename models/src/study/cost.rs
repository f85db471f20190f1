//! Cost of work: processor time of this process, and energy of the machine's processors where it counts that.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Cost of a piece of work.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    /// Processor time of all threads of the process, s; absent where the system does not report it.
    pub cpu_seconds: Option<f64>,
    /// Energy of the machine's processors, whatever else ran on them, J; absent where the machine does not count it.
    pub energy_joules: Option<f64>,
}

impl Cost {
    /// Mean cost of `count` equal pieces of work.
    pub(super) fn mean_of(self, count: usize) -> Self {
        let mean = |total: f64| total / count.max(1) as f64;
        Cost { cpu_seconds: self.cpu_seconds.map(mean), energy_joules: self.energy_joules.map(mean) }
    }
}

/// A running measurement.
pub(super) struct Meter {
    cpu_seconds: Option<f64>,
    energies: Vec<EnergyCounter>,
}

impl Meter {
    pub fn start() -> Self {
        Meter { cpu_seconds: cpu_seconds(), energies: energy_counters(Path::new("/sys/class/powercap")) }
    }

    /// Cost since the start.
    pub fn read(&self) -> Cost {
        let cpu_seconds = cpu_seconds().zip(self.cpu_seconds).map(|(now, then)| now - then);
        let joules: Option<Vec<f64>> = self.energies.iter().map(EnergyCounter::used_joules).collect();
        let energy_joules = joules.filter(|joules| !joules.is_empty()).map(|joules| joules.iter().sum());
        Cost { cpu_seconds, energy_joules }
    }
}

#[cfg(target_os = "linux")]
fn cpu_seconds() -> Option<f64> {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    Some(time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64)
}

#[cfg(not(target_os = "linux"))]
fn cpu_seconds() -> Option<f64> {
    None
}

/// Counter of a processor package's energy (RAPL; Linux, Documentation/power/powercap/powercap.rst), and its value at the start.
struct EnergyCounter {
    file: PathBuf,
    start_uj: u64,
    /// Value after which the counter begins at 0 again.
    range_uj: u64,
}

impl EnergyCounter {
    /// Energy since the start, J. It is too low for work during which the counter overflows more than once, minutes at
    /// full power.
    fn used_joules(&self) -> Option<f64> {
        let now_uj = read_number(&self.file)?;
        let overflow_uj = if now_uj < self.start_uj { self.range_uj } else { 0 };
        Some(1e-6 * (now_uj + overflow_uj).checked_sub(self.start_uj)? as f64)
    }
}

/// Counters of whole packages: `intel-rapl:0` and so on. They include their parts (`intel-rapl:0:0`).
fn energy_counters(folder: &Path) -> Vec<EnergyCounter> {
    let Ok(entries) = std::fs::read_dir(folder) else { return Vec::new() };
    let is_package = |name: &str| name.strip_prefix("intel-rapl:").is_some_and(|number| number.parse::<u32>().is_ok());
    let counter = |zone: PathBuf| {
        let file = zone.join("energy_uj");
        let (start_uj, range_uj) = (read_number(&file)?, read_number(&zone.join("max_energy_range_uj"))?);
        Some(EnergyCounter { file, start_uj, range_uj })
    };
    let packages = entries.flatten().filter(|entry| is_package(&entry.file_name().to_string_lossy()));
    packages.filter_map(|entry| counter(entry.path())).collect()
}

fn read_number(path: &Path) -> Option<u64> {
    std::fs::read_to_string(path).ok()?.trim().parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two packages count, one of which overflows; a part of a package does not count again.
    #[test]
    fn energy_is_that_of_the_packages() {
        let folder = tempfile::tempdir().expect("folder");
        let write = |zone: &str, energy_uj: u64| {
            let zone = folder.path().join(zone);
            std::fs::create_dir_all(&zone).expect("zone");
            std::fs::write(zone.join("energy_uj"), format!("{energy_uj}\n")).expect("energy");
            std::fs::write(zone.join("max_energy_range_uj"), "10000000\n").expect("range");
        };
        write("intel-rapl:0", 1_000_000);
        write("intel-rapl:0:0", 1_000_000);
        write("intel-rapl:1", 9_000_000);
        let meter = Meter { cpu_seconds: None, energies: energy_counters(folder.path()) };
        write("intel-rapl:0", 3_000_000);
        write("intel-rapl:0:0", 2_000_000);
        write("intel-rapl:1", 500_000);
        let joules = meter.read().energy_joules.expect("energy");
        assert!((joules - 3.5).abs() < 1e-9, "{joules}");
    }

    #[test]
    fn a_machine_without_counters_has_no_energy() {
        let meter = Meter { cpu_seconds: None, energies: energy_counters(Path::new("/nowhere")) };
        assert_eq!(meter.read(), Cost::default());
    }
}
