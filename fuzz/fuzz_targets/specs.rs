//! Specs of trainings, studies and datasets: accepted, or refused with a reason.

#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|input: &str| radome_fuzz::check_specs(input));
