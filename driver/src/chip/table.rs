//! Table of the registers of the BGT60TR13C and their fields; no other module holds them.
//!
//! Addresses, resets and fields are those of the vendor's library for digital core 3. If several names share bits, the
//! table has the first one. CHIP_ID is the content that silicon reads.

/// Bit field of a register.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Field {
    /// Address of the register.
    pub address: u8,
    /// Name in the datasheet.
    pub name: &'static str,
    /// Most significant bit.
    pub high: u32,
    /// Least significant bit.
    pub low: u32,
}

impl Field {
    /// Largest value that the field holds.
    pub const fn max(self) -> u32 {
        (1 << (self.high - self.low + 1)) - 1
    }

    /// Extracts the value of the field from a register's content.
    pub const fn of(self, content: u32) -> u32 {
        content >> self.low & self.max()
    }

    /// Returns a register's content with the field set to this value; bits that do not fit are cut off.
    pub const fn put(self, content: u32, value: u32) -> u32 {
        content & !(self.max() << self.low) | (value & self.max()) << self.low
    }
}

/// Register of the chip.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Register {
    /// Address.
    pub address: u8,
    /// Name in the datasheet.
    pub name: &'static str,
    /// Content after a reset.
    pub reset: u32,
    /// Fields, most significant first. Bits between them are reserved.
    pub fields: &'static [Field],
}

/// Returns the register at an address.
pub fn register(address: u8) -> Option<&'static Register> {
    REGISTERS.get(usize::from(address))
}

macro_rules! low {
    ($high:literal) => {
        $high
    };
    ($high:literal, $low:literal) => {
        $low
    };
}

macro_rules! fields {
    (constants $address:literal { $($field:ident[$high:literal $(: $low:literal)?]),* }) => {
        $(pub const $field: Field = Field {
            address: $address,
            name: stringify!($field),
            high: $high,
            low: low!($high $(, $low)?),
        };)*
    };
    (list $register:ident { $($field:ident[$high:literal $(: $low:literal)?]),* }) => {
        &[$(field::$register::$field),*]
    };
}

macro_rules! registers {
    ($($($register:ident = $address:literal),+; $reset:literal: $fields:tt)*) => {
        /// Addresses of the registers.
        pub mod address {
            #![allow(missing_docs)]
            $($(pub const $register: u8 = $address;)+)*
        }

        /// Fields of the registers.
        pub mod field {
            #![allow(missing_docs, non_snake_case)]
            $($(pub mod $register {
                use super::super::Field;
                fields!(constants $address $fields);
            })+)*
        }

        /// All registers, each at the index that is its address.
        pub static REGISTERS: [Register; 0x60] = {
            let mut all = [Register { address: 0, name: "", reset: 0, fields: &[] }; 0x60];
            $($(all[$address] = Register {
                address: $address,
                name: stringify!($register),
                reset: $reset,
                fields: fields!(list $register $fields),
            };)+)*
            all
        };
    };
}

// Registers with the same fields and the same content after a reset stand together.
registers! {
    MAIN = 0x00; 0x1E_0000: {
        LDO_MODE[23], LDO_LOAD_STRENGTH[22:21], BG_CLK_DIV[20:19], SADC_CLK_DIV[18:17], CW_MODE[16], TWKUP_MUL[15:12],
        TWKUP[11:4], FIFO_RESET[3], FSM_RESET[2], SW_RESET[1], FRAME_START[0]
    }
    ADC0 = 0x01; 0x0A_2240: {
        ADC_DIV[23:14], TRIG_MADC[12], MSB_CTRL[11], TRACK_CFG[10:9], DSCAL[8], STC[7:6], BG_CHOP_EN[5],
        BG_TC_TRIM[4:2], ADC_OVERS_CFG[1:0]
    }
    CHIP_ID = 0x02; 0x00_0303: { DIGITAL_ID[23:8], RF_ID[7:0] }
    STAT1 = 0x03; 0x00_0000: { FRAME_CNT[23:12], SHAPE_GRP_CNT[11:0] }
    PACR1 = 0x04; 0x19_6524: {
        OSCCLKEN[23], LFEN[22], CPEN[21], BIASFORC[20], ICPSEL[19:17], LOCKFORC[16], LOCKSEL[15:13], SPARE[12],
        RLFSEL[11], RFILTSEL[10], VREFSEL[9:8], U2IEN[7], BGAPEN[6], VDIGREG[5:4], DIGPON[3], VANAREG[2:1], ANAPON[0]
    }
    PACR2 = 0x05; 0x04_0014: {
        PLL_SPARE[23:20], DTSEL[19:18], TRIVREG[17], FSDNTMR[16:8], FSTDNEN[7:6], DIVEN[5], DIVSET[4:0]
    }
    SFCTL = 0x06; 0x71_0000: {
        QSPI_WT[23:20], PREFIX_EN[18], LFSR_EN[17], MISO_HF_READ[16], FIFO_LP_MODE[13], FIFO_CREF[12:0]
    }
    SADC_CTRL = 0x07; 0x00_0000: {
        TC_TRIM[16:14], DSCAL[13], LVGAIN[12], SESP[11], OVERS_CFG[10:9], SD_EN[8], START_SADC[4], SADC_CHSEL[3:0]
    }
    CSP_I_0 = 0x08, CSP_D_0 = 0x0C, CS1_U_0 = 0x10, CS1_D_0 = 0x13, CS2_U_0 = 0x17, CS2_D_0 = 0x1A, CS3_U_0 = 0x1E,
    CS3_D_0 = 0x21, CS4_U_0 = 0x25, CS4_D_0 = 0x28; 0x00_0000: {
        AMUX3_EN[23], AMUX2_EN[22], AMUX1_EN[21], BBCHGLOB_EN[20], RX4MIX_EN[19], RX4LOBUF_EN[18], RX3MIX_EN[17],
        RX3LOBUF_EN[16], RX2MIX_EN[15], RX2LOBUF_EN[14], RX1MIX_EN[13], RX1LOBUF_EN[12], LO_DISTRIB_EN[11],
        LO_MOD1_EN[10], LO_MOD1_PH[9], LO_MOD2_EN[8], LO_MOD2_PH[7], FDIV_EN[6], TEST_DIV_EN[5], VCO_EN[4], PD2_EN[3],
        TX2_EN[2], PD1_EN[1], TX1_EN[0]
    }
    CSP_I_1 = 0x09, CSP_D_1 = 0x0D, CS1_U_1 = 0x11, CS1_D_1 = 0x14, CS2_U_1 = 0x18, CS2_D_1 = 0x1B, CS3_U_1 = 0x1F,
    CS3_D_1 = 0x22, CS4_U_1 = 0x26, CS4_D_1 = 0x29; 0x00_0000: {
        BBCH_SEL[23:20], BB_RSTCNT[19:13], TEMP_MEAS_EN[12], MADC_EN[10], TX2_DAC[9:5], TX1_DAC[4:0]
    }
    CSP_I_2 = 0x0A, CSP_D_2 = 0x0E, CS1_U_2 = 0x12, CS1_D_2 = 0x15, CS2_U_2 = 0x19, CS2_D_2 = 0x1C, CS3_U_2 = 0x20,
    CS3_D_2 = 0x23, CS4_U_2 = 0x27, CS4_D_2 = 0x2A; 0x00_0000: {
        HP_GAIN[23:20], VGA_GAIN4[19:17], HPF_SEL4[16:15], VGA_GAIN3[14:12], HPF_SEL3[11:10], VGA_GAIN2[9:7],
        HPF_SEL2[6:5], VGA_GAIN1[4:2], HPF_SEL1[1:0]
    }
    CSCI = 0x0B, CSCDS = 0x0F, CS1 = 0x16, CS2 = 0x1D, CS3 = 0x24, CS4 = 0x2B; 0x00_0B60: {
        PLL_ISOPD[11], BG_TMRF_EN[10], SADC_ISOPD[9], MADC_ISOPD[8], BG_EN[7], RF_ISOPD[6], ABB_ISOPD[5], CS_EN[4],
        REPC[3:0]
    }
    CCR0 = 0x2C; 0x00_0000: { TR_MUL1[23:22], TR_INIT1[21:14], REPT[13:10], CONT_MODE[9], TMREND[8:0] }
    CCR1 = 0x2D; 0x00_0000: { TFED_MUL[23:19], TFED[18:11], PD_MODE[10:9], TMRSTRT[8:0] }
    CCR2 = 0x2E; 0x00_0000: { FRAME_LEN[23:12], MAX_FRAME_CNT[11:0] }
    CCR3 = 0x2F; 0x00_0000: { TR_MUL0[23:22], TR_INIT0[21:14], T_SSTRT[13:9], T_PAEN[8:0] }
    PLL1_0 = 0x30, PLL2_0 = 0x38, PLL3_0 = 0x40, PLL4_0 = 0x48; 0x00_0000: { FSU[23:0] }
    PLL1_1 = 0x31, PLL2_1 = 0x39, PLL3_1 = 0x41, PLL4_1 = 0x49; 0x00_0000: { RSU[23:0] }
    PLL1_2 = 0x32, PLL2_2 = 0x3A, PLL3_2 = 0x42, PLL4_2 = 0x4A; 0x00_0000: { T_EDU[23:16], RTU[13:0] }
    PLL1_3 = 0x33, PLL2_3 = 0x3B, PLL3_3 = 0x43, PLL4_3 = 0x4B; 0x00_0000: { APD[23:12], APU[11:0] }
    PLL1_4 = 0x34, PLL2_4 = 0x3C, PLL3_4 = 0x44, PLL4_4 = 0x4C; 0x00_0000: { FSD[23:0] }
    PLL1_5 = 0x35, PLL2_5 = 0x3D, PLL3_5 = 0x45, PLL4_5 = 0x4D; 0x00_0000: { RSD[23:0] }
    PLL1_6 = 0x36, PLL2_6 = 0x3E, PLL3_6 = 0x46, PLL4_6 = 0x4E; 0x00_0000: { T_EDD[23:16], RTD[13:0] }
    PLL1_7 = 0x37, PLL2_7 = 0x3F, PLL3_7 = 0x47, PLL4_7 = 0x4F; 0x00_0000: {
        T_SED_MUL[23:19], T_SED[18:11], PD_MODE[10:9], CONT_MODE[8], SH_EN[4], REPS[3:0]
    }
    ADC1 = 0x50; 0x00_0000: { TDIG_I[15:0] }
    ADC2 = 0x51; 0x00_0000: { TDIG_ADC0_O[15:0] }
    ADC3 = 0x52; 0x00_0000: { TDIG_ADC1_O[15:0] }
    ADC4 = 0x53; 0x00_0000: { TDIG_ADC2_O[15:0] }
    ADC5 = 0x54; 0x00_0000: { TDIG_ADC3_O[15:0] }
    RFT0 = 0x55; 0x00_1F40: { TEST_SIG_IF_EN[21:18], TEST_SIG_RF_EN[17:14], RFTSIGCLK_DIV_EN[13], RFTSIGCLK_DIV[12:0] }
    RFT1 = 0x56; 0x06_0000: {
        TX2_SPARE[23:22], TX1_SPARE[21], TX2_MOD_EN[20], TX1_MOD_EN[19], AMUX3_CHSEL[18:16], AMUX2_CHSEL[15:13],
        AMUX1_CHSEL[12:10], CTRL_MIX4_IFBUF[9:8], CTRL_MIX3_IFBUF[7:6], CTRL_MIX2_IFBUF[5:4], CTRL_MIX1_IFBUF[3:2]
    }
    DFT0 = 0x57; 0x00_0200: { DEBUG_DIG[19:16], CTRL[11], DBG[10], NHOLD[9], ALG[8:5], SMONEN[3:2], MODE[1:0] }
    DFT1 = 0x58; 0x00_0000: { DONE[4], FAIL[3] }
    PDFT0 = 0x59; 0x00_0000: { BYPSDM[5:2], BYPSDMEN[1], BYPRMPEN[0] }
    PDFT1 = 0x5A; 0x00_0000: {
        DITHSEL[23:22], DITHEN[21], DFTANASE[20:18], SPARE1[17:16], SPAREDFT[15:12], DFTDIGSE[11:10], DFTDIGEN[9],
        SPARE0[8:7], DFTANAEN[6], BOOSTCP[5], FRCDNLO[4], FRCDNHI[3], FRCUPHI[2], FRCUPLO[1], FSDNDEB[0]
    }
    SDFT0 = 0x5B; 0x00_0000: { TST_DIG_I[19:0] }
    SDFT1 = 0x5C; 0x00_0000: { DISCHARGE_COUNTER[20:5], CAL_RAM[4:0] }
    STAT0 = 0x5D; 0x00_00A8: {
        SH_IDX[13:11], CH_IDX[10:8], PM[7:5], LDO_RDY[3], MADC_BGUP[2], MADC_RDY[1], SADC_RDY[0]
    }
    SADC_RESULT = 0x5E; 0x00_0000: { SADC_RAW[21:12], SADC_BUSY[10], SADC_RESULT[9:0] }
    FSTAT = 0x5F; 0x10_0000: {
        FOF_ERR[23], FULL[22], CREF[21], EMPTY[20], FUF_ERR[19], BURST_ERROR[18], CLOCK_NUM_ERROR[17], FILL_STATUS[13:0]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_indices_and_fields_do_not_overlap() {
        for (index, register) in REGISTERS.iter().enumerate() {
            assert_eq!(usize::from(register.address), index, "{}", register.name);
            let mut below = 24;
            for field in register.fields {
                assert!(field.high < below && field.low <= field.high, "{} {}", register.name, field.name);
                below = field.low;
            }
        }
    }

    #[test]
    fn put_and_of_are_inverse() {
        for register in &REGISTERS {
            for field in register.fields {
                assert_eq!(field.of(field.put(0xFF_FFFF, 0)), 0);
                assert_eq!(field.of(field.put(0, field.max())), field.max());
                assert_eq!(field.put(0xFF_FFFF, field.max()), 0xFF_FFFF);
            }
        }
    }
}
