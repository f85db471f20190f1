//! Tests with a real Slurm on this machine (Debian's `slurm-wlm` and `munge`), where it is installed. An array job
//! builds a dataset or runs a study. One task is killed and requeued; the merged shards equal the bytes of a single
//! process.

use std::borrow::BorrowMut;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Mutex, MutexGuard, PoisonError};

use radome_tests::running::{Running, free_port};
use radome_tests::{command, fixture, installed, json_lines, outcome, skip, success, write_file};

use super::learning::hall_dataset;
use super::study::{STUDY, TRAININGS, progress, report, wait};

fn stdout_of(command: impl BorrowMut<Command>) -> String {
    success(command).0.trim().to_owned()
}

/// Starts a node, its controller and munge, in the order in which they are stopped and all private to `folder`. Also
/// returns the path of the configuration.
fn start(folder: &Path) -> ([Running; 3], PathBuf) {
    use std::os::unix::fs::PermissionsExt;
    let at = |name: &str| folder.join(name).display().to_string();
    fs::set_permissions(folder, fs::Permissions::from_mode(0o711)).expect("permissions");
    let mut bytes = vec![0; 128];
    std::io::Read::read_exact(&mut fs::File::open("/dev/urandom").expect("random"), &mut bytes).expect("random");
    let key = write_file(folder, "munge.key", bytes);
    fs::set_permissions(&key, fs::Permissions::from_mode(0o600)).expect("permissions");
    for name in ["state", "spool"] {
        fs::create_dir(folder.join(name)).expect("writable");
    }
    let host = stdout_of(&mut Command::new("hostname"));
    let text = format!(
        "ClusterName=t\nSlurmctldHost={host}(127.0.0.1)\nSlurmUser=root\nAuthType=auth/munge\nAuthInfo=socket={socket}\n\
         SlurmctldPort={controller}\nSlurmdPort={node}\nProctrackType=proctrack/linuxproc\nTaskPlugin=task/none\n\
         JobAcctGatherType=jobacct_gather/none\nSelectType=select/cons_tres\nSelectTypeParameters=CR_Core\n\
         StateSaveLocation={state}\nSlurmdSpoolDir={spool}\nSlurmctldPidFile={a}\nSlurmdPidFile={b}\nSlurmctldLogFile={c}\n\
         SlurmdLogFile={d}\nReturnToService=2\nSchedulerParameters=sched_interval=1\n\
         NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN\n\
         PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP\n",
        socket = at("munge.socket"),
        controller = free_port(),
        node = free_port(),
        state = at("state"),
        spool = at("spool"),
        a = at("slurmctld.pid"),
        b = at("slurmd.pid"),
        c = at("slurmctld.log"),
        d = at("slurmd.log"),
    );
    let configuration = write_file(folder, "slurm.conf", text);
    let spawn = |name: &str, arguments: &[&str]| {
        let program = installed(name).unwrap_or_else(|| panic!("{name} is absent"));
        Running::start(Command::new(program).args(arguments).env("SLURM_CONF", &configuration))
    };
    let file = |option: &str, name: &str| format!("--{option}={}", at(name));
    let options = [
        ("key-file", "munge.key"),
        ("socket", "munge.socket"),
        ("pid-file", "munge.pid"),
        ("log-file", "munge.log"),
        ("seed-file", "munge.seed"),
    ]
    .map(|(option, name)| file(option, name));
    let mut arguments = vec!["--foreground", "--force"];
    arguments.extend(options.iter().map(String::as_str));
    let munge = spawn("munged", &arguments);
    wait("munge", || folder.join("munge.socket").exists());
    let configuration_text = configuration.display().to_string();
    let controller = spawn("slurmctld", &["-D", "-f", &configuration_text]);
    let node = spawn("slurmd", &["-D", "-f", &configuration_text]);
    wait("the node", || {
        let mut info = Command::new("sinfo");
        outcome(info.args(["-h", "-o", "%T"]).env("SLURM_CONF", &configuration)).1.trim() == "idle"
    });
    ([node, controller, munge], configuration)
}

/// Slurm cluster of this machine alone, private to a folder.
struct Cluster {
    /// Daemons, dropped before their folder is removed.
    _daemons: [Running; 3],
    folder: tempfile::TempDir,
    configuration: PathBuf,
    _alone: MutexGuard<'static, ()>,
}

/// Lock that permits one cluster at a time, since each cluster uses all processors.
static ALONE: Mutex<()> = Mutex::new(());

impl Cluster {
    /// Starts the cluster. Returns `None` and counts the test as skipped where Slurm is not installed or the user is
    /// not root.
    fn start() -> Option<Self> {
        let absent: Vec<&str> = ["munged", "slurmctld", "slurmd", "sbatch", "scontrol"]
            .into_iter()
            .filter(|name| installed(name).is_none())
            .collect();
        let is_root = Command::new("id").arg("-u").output().is_ok_and(|o| o.stdout == b"0\n");
        if !absent.is_empty() || !is_root {
            skip("slurm", &format!("{absent:?} absent (apt-get install slurm-wlm munge), root: {is_root}"));
            return None;
        }
        let alone = ALONE.lock().unwrap_or_else(PoisonError::into_inner);
        let folder = tempfile::tempdir().expect("a folder");
        let (daemons, configuration) = start(folder.path());
        Some(Cluster { _daemons: daemons, folder, configuration, _alone: alone })
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Slurm command with the cluster's configuration.
    fn command(&self, name: &str) -> Command {
        let mut command = Command::new(name);
        command.env("SLURM_CONF", &self.configuration).env("RADOME_PATH", fixture("")).current_dir(self.folder.path());
        command
    }

    /// Queues a script; returns its job number.
    fn queue(&self, script: &str) -> String {
        fs::write(self.path("array.sh"), format!("{script}\n")).expect("writable");
        stdout_of(self.command("sbatch").args(["--parsable", "array.sh"]))
    }

    fn show(&self, task: &str) -> String {
        outcome(self.command("scontrol").args(["show", "job", task])).1
    }

    /// Kills a task by SIGKILL and waits until it has ended.
    fn kill(&self, task: &str) {
        stdout_of(self.command("scancel").args(["--signal=KILL", "--full", task]));
        wait("the task to be gone", || {
            let said = self.show(task);
            !said.contains("JobState=RUNNING") && !said.contains("JobState=COMPLETING")
        });
    }

    /// Requeues a task that was killed.
    fn requeue(&self, task: &str) {
        stdout_of(self.command("scontrol").args(["requeue", task]));
        // Slurm delays requeued tasks by two minutes; the test removes this delay.
        let said = self.show(task);
        let number = said.split_whitespace().find_map(|word| word.strip_prefix("JobId=")).expect("a number");
        let _ = self.command("scontrol").args(["update", &format!("JobId={number}"), "StartTime=now"]).output();
    }

    /// Number of times that a task was requeued.
    fn restarts(&self, task: &str) -> Option<String> {
        self.show(task).split_whitespace().find_map(|word| word.strip_prefix("Restarts=")).map(str::to_owned)
    }
}

#[test]
fn an_array_with_a_task_killed_and_requeued_merges_to_the_single_builds_bytes() {
    let Some(cluster) = Cluster::start() else { return };
    let path = |name: &str| cluster.path(name);
    let scene = fixture("scenes/corridor.toml").canonicalize().expect("a scene");
    let text = format!(
        "format = 1\n[map]\nscale = \"minus_one_to_one\"\nchannels = {{ one = 0 }}\nchirp_mean_removal = false\n\
         static_removal = \"slow_time_mean\"\nrange_window = \"hann\"\ndoppler_window = \"hann\"\nslow_time = \"chirps\"\n\
         amplitude = \"unnormalised\"\nfloor_db = -200.0\n\
         [[simulated]]\nscene = {scene:?}\nseeds = [1, 32]\npeople = [2]\nframes = 200\nevery = 5\n"
    );
    let spec = write_file(cluster.folder.path(), "spec.toml", text);
    json_lines(command!("dataset build --json", &spec, "-o", path("single")));

    let script = stdout_of(command!("dataset slurm --tasks 8", &spec, "-o", path("shards")));
    let job = cluster.queue(&script);

    // Kills the task as soon as it has made a unit, then requeues it.
    let parts = |index: usize| path(&format!("shards/shard-{index:05}-of-00008.parts"));
    let units = |index: usize| {
        let entries = fs::read_dir(parts(index)).into_iter().flatten().flatten();
        entries
            .filter(|e| e.file_name().to_string_lossy().starts_with("unit-") && e.path().extension().is_none())
            .count()
    };
    let mut killed = None;
    wait("a task to be at work", || {
        killed = (0..8).find(|index| units(*index) > 0);
        killed.is_some()
    });
    let index = killed.expect("one is at work");
    let task = format!("{job}_{index}");
    cluster.kill(&task);
    assert!(parts(index).exists(), "task {index} was killed in the middle of its work");
    cluster.requeue(&task);
    wait("the array", || (0..8).all(|i| path(&format!("shards/shard-{i:05}-of-00008")).exists()));
    assert_eq!(cluster.restarts(&task).as_deref(), Some("1"), "{}", cluster.show(&task));
    let log = fs::read_to_string(path(&format!("radome-spec-{job}_{index}.log"))).expect("a log");
    assert!(log.contains("units are there"), "it went on where it was: {log}");

    let shards = (0..8).map(|i| path(&format!("shards/shard-{i:05}-of-00008")));
    json_lines(command!("dataset merge --json -o", path("merged"), ..shards));
    for entry in fs::read_dir(path("single")).expect("a folder").flatten() {
        let other = path("merged").join(entry.file_name());
        assert!(
            fs::read(entry.path()).expect("reads") == fs::read(&other).expect("reads"),
            "{} differs",
            other.display()
        );
    }
    assert_eq!(
        fs::read_dir(path("merged")).expect("a folder").count(),
        fs::read_dir(path("single")).expect("a folder").count()
    );
}

#[test]
fn a_study_with_a_task_killed_and_requeued_reports_the_bytes_of_one_run() {
    let Some(cluster) = Cluster::start() else { return };
    let path = |name: &str| cluster.path(name);
    let spec = write_file(cluster.folder.path(), "study.toml", STUDY);
    let study = |name: &str| command!("model study --json", &spec, "--dataset", hall_dataset(), "-o", path(name));
    json_lines(study("single"));

    let job = cluster.queue(&stdout_of(command!(
        "model slurm --tasks 6",
        &spec,
        "--dataset",
        hall_dataset(),
        "-o",
        path("array")
    )));
    // Two tasks run in parallel, the first before the others.
    wait("the first task to be at work", || progress(&path("array")).iter().any(|count| *count > 0));
    let task = format!("{job}_0");
    cluster.kill(&task);
    cluster.requeue(&task);
    let log = |index: usize| path(&format!("radome-study-{job}_{index}.log"));
    let is_done = |index: usize| fs::read_to_string(log(index)).is_ok_and(|text| text.contains("trainings are done"));
    wait("the array", || progress(&path("array")) == [TRAININGS, 0]);
    wait("the first task", || cluster.show(&task).contains("JobState=COMPLETED"));
    assert_eq!(cluster.restarts(&task).as_deref(), Some("1"), "{}", cluster.show(&task));
    assert!((0..6).any(is_done), "shards say how far the study is");
    json_lines(study("array").arg("--report-only"));
    assert_eq!(report(&path("array")), report(&path("single")));
}
